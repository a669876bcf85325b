"""A finished dive keeps what its places are recognised by; failing to costs nothing else."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config import Config
from aquaflow.dive import deliverables as places_of_dive
from aquaflow.dive.replay import map_recording
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import NAME, KeyframePlace, PlacesFile, Rows
from aquaflow.keyframes.store import Keyframe
from aquaflow.sources import open_recording
from aquaflow.telemetry.metric_file import read_metric_file
from aquaflow.tracking.graph.table import Snapshot

TRACKING_ONLY = Config.model_validate({"mapping": {"enabled": False}, "source": {"stop": 14}})


def mapped(recording: Path, dive: Path) -> Path:
    return map_recording(open_recording(recording), "x", dive, TRACKING_ONLY).dive


def trajectory(dive: Path) -> np.ndarray:
    return np.loadtxt(dive / "trajectory.tum")


def test_keyframes_lie_where_the_trajectory_says(small_recording: Path, tmp_path: Path) -> None:
    dive = mapped(small_recording, tmp_path / "dive")
    file, frames, path = PlacesFile(dive / NAME), read_metric_file(dive), trajectory(dive)
    metrics = json.loads((dive / "metrics.json").read_text())
    assert len(file.places) == metrics["keyframes"] > 1
    for place in file.places:
        T_nc = frames[place.sub_map].pose(place.T_mc)
        nearest = path[np.abs(path[:, 0] - 1e-9 * place.t_ns).argmin()]
        assert np.allclose(T_nc.t, nearest[1:4], atol=1e-6)
        assert file.keypoints(place.number).is_known(0.15).sum() > 100
    joined = set(file.edges["a"]) | set(file.edges["b"])
    assert joined == {place.number for place in file.places}


@pytest.mark.usefixtures("contained")
def test_a_keyframe_that_cannot_be_read_back_costs_itself(
    small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = places_of_dive._place

    def fail(keyframe: Keyframe, poses: Mapping[int, Sim3]) -> KeyframePlace:
        if keyframe.number == 0:
            raise InputError("planted")
        return whole(keyframe, poses)

    monkeypatch.setattr(places_of_dive, "_place", fail)
    dive = mapped(small_recording, tmp_path / "dive")
    file = PlacesFile(dive / NAME)
    assert [place.number for place in file.places] == list(range(1, len(file.places) + 1))
    assert 0 not in file.edges["b"]


@pytest.mark.usefixtures("contained")
def test_places_that_cannot_be_written_cost_no_other_file(
    small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(graph: Snapshot) -> Rows:
        raise RuntimeError("planted")

    monkeypatch.setattr(places_of_dive, "_edges", fail)
    dive = mapped(small_recording, tmp_path / "dive")
    assert not (dive / NAME).exists()
    assert len(trajectory(dive)) > 0
    notes = json.loads((dive / "metrics.json").read_text())["notes"]
    assert any("places.npz" in note for note in notes)
