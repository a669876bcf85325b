"""Configs of vehicles: the examples are valid, mistakes are named by their path."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.config.cameras import OakConfig, StreamConfig, V4l2Config
from aquaflow.config.vehicle import VehicleConfig, load_vehicle
from aquaflow.sources import open_camera

EXAMPLES = sorted((Path(__file__).parents[2] / "deploy" / "config").glob("*.yaml"))

COMMENTED_SETTING = re.compile(r"^( +)# ( *\w+:( .*)?)$", re.MULTILINE)
"""A sentence has a space before its first colon."""

V4L2 = {"kind": "v4l2", "device": "abc"}


def load(tmp_path: Path, data: dict[str, Any]) -> VehicleConfig:
    path = tmp_path / "vehicle.yaml"
    path.write_text(yaml.safe_dump(data))
    return load_vehicle(path)


def test_there_is_an_example_for_each_kind_of_vehicle() -> None:
    assert [path.stem for path in EXAMPLES] == [
        "auv_instruments",
        "bluerov2_usb",
        "can_vehicle",
        "oak_in_housing",
    ]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_is_valid(path: Path) -> None:
    config = load_vehicle(path)
    assert config.cameras
    assert config.telemetry.devices


@pytest.mark.parametrize(
    ("name", "settings"),
    [("auv_instruments", 4), ("bluerov2_usb", 15), ("oak_in_housing", 2), ("can_vehicle", 0)],
)
def test_settings_that_an_example_leaves_as_comments_are_valid_too(
    name: str, settings: int, tmp_path: Path
) -> None:
    (example,) = (path for path in EXAMPLES if path.stem == name)
    text, count = COMMENTED_SETTING.subn(r"\1\2", example.read_text())
    assert count == settings
    shown = tmp_path / example.name
    shown.write_text(text)
    load_vehicle(shown)


@pytest.mark.parametrize(
    ("camera", "path"),
    [
        ({**V4L2, "fsp": 3}, "cameras.front.v4l2.fsp' is not a known key"),
        ({**V4L2, "fps": 0}, "cameras.front.v4l2.fps"),
        ({**V4L2, "pixels": "RGB3"}, "cameras.front.v4l2.pixels"),
        ({"kind": "webcam"}, "cameras.front"),
        ({"device": "abc"}, "cameras.front"),
        ({"kind": "stream"}, "cameras.front.stream.url"),
        ({"kind": "stream", "url": "ftp://host/a"}, "cameras.front.stream.url"),
        ({"kind": "oak", "exposure_s": 0.01}, "cameras.front.oak"),
        ({"kind": "oak", "mounting": {"pitch": 3}}, "cameras.front.oak.mounting.pitch"),
    ],
)
def test_a_mistake_is_named_with_its_path(
    tmp_path: Path, camera: dict[str, Any], path: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, {"cameras": {"front": camera}})
    assert path in str(caught.value)


def test_mapping_is_set_in_the_same_file(tmp_path: Path) -> None:
    config = load(tmp_path, {"seed": 3, "mapping": {"max_gaussians": 2000}, "cameras": {"a": V4L2}})
    assert (config.seed, config.mapping.max_gaussians) == (3, 2000)
    assert VehicleConfig.model_validate(config.model_dump(mode="json")) == config


@pytest.mark.parametrize(
    ("config", "driver"),
    [
        (V4l2Config(kind="v4l2"), "V4l2Camera"),
        (OakConfig(kind="oak"), "OakCamera"),
        (StreamConfig(kind="stream", url="rtsp://host/a"), "StreamCamera"),
    ],
)
def test_every_kind_of_camera_has_its_driver(
    config: V4l2Config | OakConfig | StreamConfig, driver: str
) -> None:
    camera = open_camera("front", config)
    assert type(camera).__name__ == driver
    camera.close()


def test_a_driver_that_is_not_installed_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aquaflow.sources.entry_points", lambda *, group: [])
    with pytest.raises(InputError, match="no driver for cameras of kind 'oak'; reinstall"):
        open_camera("front", OakConfig(kind="oak"))


def test_a_calibration_that_is_not_there_is_told_at_once(tmp_path: Path) -> None:
    config = V4l2Config(kind="v4l2", calibration=tmp_path / "none.yaml")
    with pytest.raises(InputError, match="cannot read the calibration"):
        open_camera("front", config)
