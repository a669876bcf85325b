"""The one reader of a dive folder: what it reads, when, and what it says of a bad file."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import aquaflow
from aquaflow.base.errors import InputError
from aquaflow.dive.deliverables import read_finished_frames
from aquaflow.dive.dive import Dive
from aquaflow.survey.report.page import render_report
from aquaflow.survey.report.report_of import report_of


@pytest.fixture
def dive(small_dive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_dive, tmp_path / "dive"))


def test_a_file_is_read_when_it_is_first_asked_for_and_then_kept(dive: Path) -> None:
    read = Dive(dive)
    (dive / "medium.json").write_text("damaged")
    assert len(read.trajectory) == read.metrics["tracked"]
    (dive / "trajectory.tum").unlink()
    assert len(read.trajectory) == read.metrics["tracked"]
    with pytest.raises(InputError, match=r"medium\.json"):
        _ = read.medium


def test_what_is_known_is_not_read(tmp_path: Path) -> None:
    read = Dive(tmp_path, metrics={"frames": 3, "complete": False}, name="running", main=2)
    assert (read.metrics["frames"], read.name, read.main) == (3, "running", 2)
    assert read.is_going_on
    with pytest.raises(AssertionError, match="no_such"):
        Dive(tmp_path, no_such=1)


def test_what_an_older_dive_lacks_is_unknown(tmp_path: Path) -> None:
    read = Dive(tmp_path)
    assert read.metrics == read.medium_facts == read.metric_frames == {}
    assert read.medium is None
    assert read.calibration is None
    assert list(read.held_out) == []
    assert not read.frame.metric
    assert read.unit == "map units"
    assert read.status is None


@pytest.mark.parametrize(
    ("name", "attribute"),
    [
        ("frames.csv", "frames"), ("trajectory.tum", "trajectory"), ("trajectory.csv", "poses"),
        ("metrics.json", "metrics"), ("metric.json", "metric_frames"), ("places.npz", "places"),
        ("medium.json", "medium"), ("camera.yaml", "camera"), ("config.yaml", "config"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_named_in_one_sentence(dive: Path, name: str, attribute: str) -> None:
    (dive / name).write_bytes(b"{\xff\x00 damaged")
    with pytest.raises(aquaflow.AquaFlowError) as caught:
        getattr(Dive(dive), attribute)
    said = str(caught.value)
    assert name in said
    assert "\n" not in said


def test_held_out_views_are_those_of_the_folder(small_dive: Path) -> None:
    read = Dive(small_dive)
    assert len(read.held_out) == read.metrics["heldout_frames"] > 0
    first = read.held_out[0]
    size = (read.camera.height, read.camera.width)
    assert first.real.shape[:2] == first.rendered.shape[:2] == size


def test_its_map_is_read_once_and_a_missing_or_empty_one_is_refused(dive: Path) -> None:
    read = Dive(dive)
    assert read.map() is read.map(read.main)
    assert len(read.map().gaussians) == read.metrics["gaussians"]
    (dive / "map.aqf").unlink()
    with pytest.raises(InputError, match=r"map\.aqf"):
        Dive(dive).map()
    with pytest.raises(InputError, match=r"holds no finished dive: map\.aqf is missing"):
        Dive(dive).require("frames.csv", "map.aqf")


def test_every_frame_is_there_with_its_pose(small_dive: Path) -> None:
    read = Dive(small_dive)
    frames = read_finished_frames(read)
    assert len(frames) == len(read)
    posed = [frame for frame in frames if frame.T_nc is not None]
    places = np.array([frame.T_nc.t for frame in posed if frame.T_nc is not None])
    np.testing.assert_array_equal(places, read.trajectory.positions)


def test_the_report_of_a_running_dive_shows_nothing_of_an_earlier_end(dive: Path) -> None:
    whole = render_report(report_of(Dive(dive)))
    metrics = json.loads((dive / "metrics.json").read_text()) | {"complete": False}
    moment = render_report(report_of(Dive(dive, metrics=metrics, held_out=[])))
    for section in ("The map from above", "The ground in numbers"):
        assert section in whole
        assert section not in moment
    assert "The path" in moment
