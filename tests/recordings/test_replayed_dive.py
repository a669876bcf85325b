"""A recorded dive, mapped: the same as its source."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from aquaflow.config.service import RecordingConfig
from aquaflow.live.recorder import Recorder
from aquaflow.recordings.mcap_telemetry import McapTelemetry
from aquaflow.sources import mounting_of, open_recorded_telemetry, open_recording
from tests.command_line import Cli
from tests.small_recording import QUICK

SAME = ("trajectory.tum", "map.ply", "map_clear.ply", "medium.json")


@pytest.fixture(scope="module")
def recorded(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small synthetic dive, some hours after the computer was started."""
    out = tmp_path_factory.mktemp("recorded")
    recorder = Recorder(out, RecordingConfig(picture="raw", keep_received=False, reserve_mb=0))
    source = open_recording(small_recording)
    recorder.record_mounting("camera", mounting_of(source))
    for frame in source.frames():
        recorder.frame("camera", frame)
    for sample in open_recorded_telemetry(small_recording).samples():
        recorder.sample(sample)
    assert recorder.close().dropped == {}
    return out


def rows_without_names(dive: Path) -> list[list[str]]:
    """frames.csv but for the names of the pictures, which a recording does not keep."""
    with (dive / "frames.csv").open() as file:
        table = list(csv.DictReader(file))
    return [[value for key, value in row.items() if key != "source"] for row in table]


@pytest.mark.ci
def test_a_recorded_dive_maps_to_the_bytes_that_its_source_maps_to(
    aquaflow: Cli, recorded: Path, small_dive: Path, tmp_path: Path
) -> None:
    dive = tmp_path / "dive"
    ran = aquaflow("map", recorded, "--out", dive, *QUICK)
    assert ran.code == 0, ran.err
    for name in SAME:
        assert (dive / name).read_bytes() == (small_dive / name).read_bytes(), name
    assert rows_without_names(dive) == rows_without_names(small_dive)


def test_its_telemetry_is_that_of_its_source(recorded: Path, small_recording: Path) -> None:
    source = list(open_recorded_telemetry(small_recording).samples())
    assert list(McapTelemetry(recorded).samples()) == source
