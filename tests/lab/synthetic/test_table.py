"""telemetry.csv: what is written is read back, and older files are read."""

from __future__ import annotations

from dataclasses import astuple
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import simulate
from aquaflow.lab.synthetic.telemetry import HEADER, read_telemetry, write_telemetry
from aquaflow.types import (
    AngularRate,
    Attitude,
    Depth,
    Lights,
    Position,
    TelemetrySample,
    UtcTime,
    Velocity,
)


def numbers(sample: TelemetrySample) -> list[float]:
    """Its values, without times and source."""
    values = (v if isinstance(v, tuple) else (v,) for v in astuple(sample)[3:])
    return list(chain.from_iterable(values))


def test_every_kind_comes_back_from_the_file(tmp_path: Path) -> None:
    config = SyntheticConfig.model_validate(
        {"frames": 30, "telemetry": {"position_hz": 2.0, "utc_hz": 2.0}}
    )
    written = simulate(config).samples
    write_telemetry(tmp_path / "telemetry.csv", written)
    read = list(read_telemetry(tmp_path / "telemetry.csv"))
    assert len({type(sample) for sample in written}) == 8
    assert [type(sample) for sample in read] == [type(sample) for sample in written]
    for one, other in zip(read, written, strict=True):
        assert astuple(one)[:3] == astuple(other)[:3]
        np.testing.assert_allclose(numbers(one), numbers(other), rtol=1e-8, atol=1e-12)


def test_positions_and_utc_keep_every_digit(tmp_path: Path) -> None:
    samples: list[TelemetrySample] = [
        Position(1, 2, "usbl", 63.450000000000017, -179.99999999999997, 1.1),
        UtcTime(3, 4, "clock", 1_780_300_800_123_456_789),
    ]
    write_telemetry(tmp_path / "telemetry.csv", samples)
    assert list(read_telemetry(tmp_path / "telemetry.csv")) == samples


def test_files_of_version_1_are_still_read(tmp_path: Path) -> None:
    file = tmp_path / "telemetry.csv"
    file.write_text(
        "t_s,arrival_s,kind,source,v0,v1,v2,v3\n"
        "0.000000000,0.010000000,depth,synthetic,10.5,,,\n"
        "0.000000000,0.020000000,attitude,synthetic,1,0,0,0\n"
        "0.100000000,0.120000000,angular_rate,synthetic,0.1,0.2,0.3,\n"
        "0.200000000,0.230000000,velocity,synthetic,0.5,0.0,-0.1,0.01\n"
    )
    assert list(read_telemetry(file)) == [
        Depth(0, 10_000_000, "synthetic", 10.5),
        Attitude(0, 20_000_000, "synthetic", (1.0, 0.0, 0.0, 0.0)),
        AngularRate(100_000_000, 120_000_000, "synthetic", (0.1, 0.2, 0.3)),
        Velocity(200_000_000, 230_000_000, "synthetic", (0.5, 0.0, -0.1), 0.01),
    ]


@pytest.mark.parametrize(
    "line",
    [
        "0,0,depth,x,deep,,,",
        "0,0,depth,x,,,,",
        "0,0,depth,x,1,2,,",
        "0,0,temperature,x,1,,,",
        "0,0,utc_time,x,1.5,,,",
        "0,0,velocity,x,1,2,3,",
        "never,0,depth,x,1,,,",
        "0,0,depth",
    ],
)
def test_a_line_that_is_no_sample_is_refused_in_one_sentence(tmp_path: Path, line: str) -> None:
    file = tmp_path / "telemetry.csv"
    file.write_text(",".join(HEADER) + "\n" + line + "\n")
    with pytest.raises(InputError, match="no telemetry sample"):
        list(read_telemetry(file))


def test_a_kind_without_a_column_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no kind for Lights"):
        write_telemetry(tmp_path / "telemetry.csv", [Lights(0, 0, "lamp", 0.5)])
