"""Epipolar distances of a dive and its truth, on a small synthetic recording."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import write_yaml
from aquaflow.config import Config
from aquaflow.dive.tum import write_tum
from aquaflow.lab.evaluation.epipolar_error import evaluate_epipolar
from aquaflow.lab.evaluation.summary import in_words
from aquaflow.lab.evaluation.trajectory_error import read_tum


def bent(path: Path, degrees: float, to: Path) -> Path:
    """The trajectory with a pitch that grows to ``degrees`` at its end."""
    poses = read_tum(path)
    angles = np.linspace(0.0, degrees, len(poses))[:, None]
    turns = Rotation.from_euler("x", angles, degrees=True)
    turned = Rotation.from_quat(poses.wxyz, scalar_first=True) * turns
    write_tum(to, poses.t_s, poses.positions, turned.as_quat(scalar_first=True))
    return to


@pytest.fixture
def dive(small_recording: Path, tmp_path: Path) -> Path:
    """A dive whose trajectory is the truth."""
    folder = tmp_path / "dive"
    folder.mkdir()
    poses = read_tum(small_recording / "poses.tum")
    shutil.copy(small_recording / "poses.tum", folder / "trajectory.tum")
    shutil.copy(small_recording / "camera.yaml", folder / "calibration.yaml")
    write_yaml(folder / "config.yaml", Config.model_validate({}).model_dump(mode="json"))
    rows = [f"{i},{i}.png,{t:.6f},common,0" for i, t in enumerate(poses.t_s)]
    (folder / "frames.csv").write_text("\n".join(["index,source,t_s,class,sub_map", *rows]) + "\n")
    return folder


def test_a_bent_truth_is_seen_to_be_the_worse_trajectory(dive, small_recording, tmp_path):
    truth = bent(small_recording / "poses.tum", 6.0, tmp_path / "bent.tum")

    result = evaluate_epipolar(dive, small_recording, truth)

    assert result.gaps[0].matches > 100
    for gap in result.gaps[:4]:
        assert gap.dive_px < 0.5
        assert gap.truth_px > 2.0 * gap.dive_px
    assert any("best fit of each pair" in line for line in in_words({"epipolar": result.to_json()}))


def test_without_a_truth_only_the_dive_is_measured(dive, small_recording):
    result = evaluate_epipolar(dive, small_recording, None).to_json()

    assert {gap["truth_px"] for gap in result["gaps"]} == {None}


def test_a_dive_without_calibration_uses_the_camera_that_it_found(dive, small_recording):
    (dive / "calibration.yaml").rename(dive / "camera.yaml")

    assert evaluate_epipolar(dive, small_recording, None).gaps[0].dive_px < 0.5


def test_another_recording_is_refused_in_one_sentence(dive, pictures):
    with pytest.raises(InputError, match="fewer than 40 keypoints in common"):
        evaluate_epipolar(dive, pictures, None)


def test_a_truth_of_other_moments_is_refused(dive, small_recording, tmp_path):
    poses = read_tum(small_recording / "poses.tum")
    write_tum(tmp_path / "late.tum", poses.t_s + 1000.0, poses.positions, poses.wxyz)

    with pytest.raises(InputError, match="fewer than two poses"):
        evaluate_epipolar(dive, small_recording, tmp_path / "late.tum")
