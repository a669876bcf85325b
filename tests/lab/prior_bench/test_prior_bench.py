"""``lab prior bench``: a row for every prior, size and kind of frame, and what was found."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from aquaflow import cli
from aquaflow.base.errors import InputError
from aquaflow.lab.prior_bench import benchmark
from aquaflow.lab.prior_bench.latency import measure_time, sea_floor
from aquaflow.prior.factory import SHIPPED
from aquaflow.prior.folder import CARD

ROW = {"prior", "variant", "threads", "width", "height", "work", "ms", "cpu_ms"}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "SIZES", ((64, 48),))
    monkeypatch.setattr(benchmark, "PAIRS", 1)
    monkeypatch.setattr(benchmark, "LEVELS", benchmark.LEVELS[:1])


@pytest.mark.usefixtures("quick")
def test_every_prior_that_is_here_has_its_rows_and_its_recall() -> None:
    pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
    result = CliRunner().invoke(cli.app, ["lab", "prior", "bench", "--repeats", "1", "--json"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout)
    names = ["classical none"]
    if (SHIPPED / CARD).is_file():
        names += ["compact fp32", "compact int8"]
    assert all(set(row) == ROW for row in said["rows"])
    assert [f"{row['prior']} {row['variant']}" for row in said["rows"][::2]] == names
    assert {row["work"] for row in said["rows"]} == {"tracked", "found"}
    assert list(said["recall"]) == names
    assert all(said["recall"][name]["mild"]["recall"] > 0.9 for name in names)


@pytest.mark.usefixtures("quick")
def test_the_table_says_what_the_machine_was() -> None:
    result = CliRunner().invoke(cli.app, ["lab", "prior", "bench", "--repeats", "1"])
    assert "64 x 48" in result.stdout
    assert "cores, load" in result.stdout


def test_a_time_is_the_median_of_at_least_three() -> None:
    calls: list[int] = []
    spent = measure_time(lambda: calls.append(0), 1)
    assert len(calls) == 3
    assert spent.ms >= 0.0


def test_a_folder_without_pictures_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--pictures"):
        benchmark.bench_prior([], [1], "cpu", tmp_path, 1, lambda *_: None)


def test_pictures_of_a_folder_are_those_that_are_matched(tmp_path: Path) -> None:
    picture = sea_floor(32, 24)
    cv2.imwrite(str(tmp_path / "a.png"), picture[..., ::-1])
    (tmp_path / "notes.txt").write_text("no picture")
    [found] = benchmark.pictures_in(tmp_path)
    np.testing.assert_array_equal(found, picture)
