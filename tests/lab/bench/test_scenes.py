"""Scenes made from another dive keep their truth; suites find their scenes."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.lab.bench.ci_suite import dim_light, pause
from aquaflow.lab.bench.scene import real_scenes, scene_at
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.sources import open_recording


def picture(dive: Path, index: int) -> np.ndarray:
    found = cv2.imread(str(dive / "images" / f"{index:06d}.png"))
    assert found is not None
    return found.astype(float)


def test_a_pause_repeats_the_pose_and_delays_what_follows(
    small_recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "paused"
    pause(small_recording, out, at=5, frames=3)
    before, after = read_tum(small_recording / "poses.tum"), read_tum(out / "poses.tum")
    assert len(after) == len(before) + 3
    for k in (6, 7, 8):
        assert np.array_equal(after.positions[k], before.positions[5])
        assert np.array_equal(after.wxyz[k], before.wxyz[5])
    assert np.array_equal(after.positions[9:], before.positions[6:])
    step = before.t_s[1] - before.t_s[0]
    assert np.allclose(np.diff(after.t_s), step)
    assert np.isclose(after.path_length, before.path_length)


def test_a_paused_camera_sees_the_same_with_other_noise(
    small_recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "paused"
    pause(small_recording, out, at=5, frames=3)
    assert np.array_equal(picture(out, 5), picture(small_recording, 5))
    difference = picture(out, 7) - picture(small_recording, 5)
    assert 0.5 < difference.std() < 3.0
    assert np.array_equal(picture(out, 9), picture(small_recording, 6))
    for kind, old, new in (("range", 5, 7), ("range", 6, 9)):
        stored = np.load(out / kind / f"{new:06d}.npz")["range_m"]
        assert np.array_equal(stored, np.load(small_recording / kind / f"{old:06d}.npz")["range_m"])


def test_the_light_changes_from_one_picture_on_and_nothing_else_does(
    small_recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "dimmed"
    dim_light(small_recording, out, at=10, gain=0.5)
    assert np.array_equal(picture(out, 9), picture(small_recording, 9))
    assert np.abs(picture(out, 10) - 0.5 * picture(small_recording, 10)).max() <= 0.5
    assert (out / "poses.tum").read_text() == (small_recording / "poses.tum").read_text()
    assert (out / "medium.yaml").read_text() == (small_recording / "medium.yaml").read_text()


def test_an_altered_dive_opens_as_a_synthetic_dive(small_recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "paused"
    pause(small_recording, out, at=0, frames=2)
    assert open_recording(out).frame_count == 26
    scene = scene_at(out)
    assert scene.truth == scene.clean == str(out)


def test_a_pause_after_the_end_is_refused(small_recording: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="24 pictures"):
        pause(small_recording, tmp_path / "paused", at=24, frames=1)


def test_the_real_suite_takes_every_folder_with_a_clip_and_its_truth(
    small_recording: Path, tmp_path: Path
) -> None:
    clip = tmp_path / "clip"
    shutil.copytree(small_recording / "images", clip)
    shutil.copyfile(small_recording / "camera.yaml", clip / "camera.yaml")
    poses = (small_recording / "poses.tum").read_text().splitlines()
    (clip / "poses_sfm.tum").write_text("\n".join(poses[::4]) + "\n")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "depth.csv").write_text("t\n")
    (scene,) = real_scenes(tmp_path)
    assert scene.name == "clip"
    assert scene.truth == str(clip / "poses_sfm.tum")
    assert scene.calibration == str(clip / "camera.yaml")
    # 24 pictures are too few to leave any out.
    assert scene.overrides == {"source": {"every": 1}}


def test_what_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no scene at"):
        scene_at(tmp_path / "nothing")
    with pytest.raises(InputError, match="no folder in"):
        real_scenes(tmp_path)
    with pytest.raises(InputError, match="no data folder"):
        real_scenes(tmp_path / "nothing")
