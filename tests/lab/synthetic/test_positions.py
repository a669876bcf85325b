"""The fixes beside a synthetic dive: a table that puts it on the earth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.dive.dive import read_dive
from aquaflow.geometry.earth import latitude_longitude
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.site import site_of
from aquaflow.lab.synthetic.telemetry.measurement import write_positions
from aquaflow.recordings.csv_telemetry import CsvTelemetry
from aquaflow.types import Position
from tests.command_line import Cli
from tests.small_recording import HASTY


def test_the_table_holds_fixes_of_the_body_as_they_were_measured(tmp_path: Path) -> None:
    quiet = {"position_outlier_share": 0.0, "position_sigma_m": 0.3}
    config = SyntheticConfig.model_validate({"scene": "survey", "frames": 90, "telemetry": quiet})
    motion = site_of(config, least_cell_m=0.2).motion
    write_positions(tmp_path / "positions.csv", config, motion)
    table = CsvTelemetry(tmp_path / "positions.csv", 0.0)
    fixes = list(table.samples())
    assert table.notes == []
    assert len(fixes) > 10
    origin = config.telemetry.origin_latitude_deg, config.telemetry.origin_longitude_deg
    degree_m = 111_320.0 * np.array([1.0, np.cos(np.radians(origin[0]))])
    off = []
    for fix in fixes:
        assert isinstance(fix, Position)
        heard_s = 1e-9 * fix.t_ns - config.telemetry.position_lag_s
        true = latitude_longitude(motion.origin_w(np.array([heard_s])) * [1.0, 1.0, 0.0], origin)
        place = np.array([fix.latitude_deg, fix.longitude_deg])
        off.append((place - np.ravel(true)) * degree_m)
        assert fix.sigma_m == pytest.approx(0.3)
    assert 0.2 < np.std(off) < 0.4


@pytest.mark.ci
def test_a_synthetic_dive_is_mapped_onto_the_earth_by_its_table(
    aquaflow: Cli, tmp_path: Path
) -> None:
    recording, dive = tmp_path / "recording", tmp_path / "dive"
    size = ("--scene", "survey", "--frames", 12, "--width", 160, "--height", 120)
    ran = aquaflow("lab", "synth", recording, *size)
    asked = ran.out.split("on the earth: ")[1].split()
    ran = aquaflow("map", recording, "--out", dive, *HASTY, *asked)
    assert ran.code == 0, ran.err
    read = read_dive(dive)
    assert read.frame.georeferenced
    assert read.frame.origin is not None
    north, east = 111_320.0 * (
        (np.array([read.poses[0].latitude_deg, read.poses[0].longitude_deg]) - (63.45, 10.40))
        * (1.0, np.cos(np.radians(63.45)))
    )
    true = np.loadtxt(recording / "poses.tum")[0, 1:3]
    assert np.hypot(north - true[0], east - true[1]) < 4.0 * read.frame.origin.sigma_m
    assert aquaflow("export", dive, "--format", "geotags").code == 0
