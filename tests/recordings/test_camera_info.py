"""CameraInfo of ROS: which belongs to a topic, and what that topic's pictures are (REP 104)."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from aquaflow.geometry.camera import CameraModel, load_camera, save_camera
from aquaflow.recordings.picture_message import (
    camera_of_info,
    choose_topic,
    info_topic,
    is_rectified,
)


def info(**changes: Any) -> SimpleNamespace:
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    values: dict[str, Any] = {
        "width": 640, "height": 480, "distortion_model": "plumb_bob", "binning_x": 0,
        "binning_y": 0, "roi": roi, "d": np.array([-0.3, 0.1, 0.0, 0.0, 0.0]),
        "k": np.array([500.0, 0, 319.5, 0, 510.0, 239.5, 0, 0, 1]),
        "p": np.array([450.0, 0, 310.5, 0, 0, 460.0, 230.5, 0, 0, 0, 1, 0]),
    }  # fmt: skip
    return SimpleNamespace(**(values | changes))


def made(message: SimpleNamespace, rectified: bool = False) -> CameraModel:
    camera = camera_of_info(message, rectified)
    assert isinstance(camera, CameraModel)
    return camera


def test_pictures_as_taken_have_k_and_d() -> None:
    camera = made(info())
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 510, 320, 240)
    assert camera.distortion_model == "radtan"
    assert camera.distortion[0] == -0.3


def test_rectified_pictures_have_p_and_no_distortion() -> None:
    camera = made(info(), rectified=True)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (450, 460, 311, 231)
    assert not camera.is_distorted


def test_a_part_of_the_sensor_and_binning_move_the_camera() -> None:
    roi = SimpleNamespace(x_offset=100, y_offset=40, width=400, height=320)
    camera = made(info(roi=roi, binning_x=2, binning_y=2))
    assert (camera.width, camera.height) == (200, 160)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (250, 255, 110, 100)


@pytest.mark.parametrize("name", ["equidistant", "fisheye", "kannala_brandt"])
def test_fisheye_models_are_used(name: str) -> None:
    message = info(distortion_model=name, d=np.array([0.1, 0.02, 0.0, 0.0]))
    assert made(message).distortion_model == "fisheye"


def test_what_cannot_be_used_says_why() -> None:
    assert "never calibrated" in str(camera_of_info(info(k=np.zeros(9)), rectified=False))
    assert "'mei'" in str(camera_of_info(info(distortion_model="mei"), rectified=False))


INFOS = ["/cam1/camera_info", "/cam1_down/camera_info", "/stereo/left/camera_info"]


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/cam1/image_raw", "/cam1/camera_info"),
        ("/cam1/image_raw/compressed", "/cam1/camera_info"),
        ("/cam1_down/image_raw", "/cam1_down/camera_info"),
        ("/cam1/rgb/image_rect", "/cam1/camera_info"),
        ("/cam/image_raw", None),
        ("/stereo/right/image_raw", None),
        ("/image_raw", None),
    ],
)
def test_a_topic_has_the_camera_info_of_its_own_namespace(topic: str, expected: str | None) -> None:
    assert info_topic(topic, INFOS) == expected


def test_rectified_topics_and_the_topic_to_map_are_told_by_name() -> None:
    assert is_rectified("/cam/image_rect_color/compressed")
    assert not is_rectified("/rect/image_raw")
    counts = [("/camera/aligned_depth/image_raw", 90), ("/camera/color/image_raw", 30)]
    assert choose_topic(counts) == "/camera/color/image_raw"


def test_a_calibration_of_numpys_numbers_is_written(tmp_path: Path) -> None:
    fx = np.float64(500.0)
    camera = CameraModel(
        640, 480, fx, fx, fx, np.float32(240), "radtan", (0.1, fx * 0, fx * 0, fx * 0)
    )
    save_camera(camera, tmp_path / "camera.yaml")
    assert load_camera(tmp_path / "camera.yaml") == camera
    assert yaml.safe_load((tmp_path / "camera.yaml").read_text())["fx"] == 500.0
