"""`aquaflow config FILE` and `doctor --config FILE`: both kinds of file, and what they open."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import pytest
import yaml

from aquaflow.config.vehicle import load_any, load_vehicle
from aquaflow.doctor import MachineProbes
from aquaflow.doctor.opened import check_opened
from tests.command_line import Cli, refused

SHIPPED = sorted((Path(__file__).parents[2] / "deploy" / "config").glob("*.yaml"))


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_every_shipped_file_is_completed_and_loads_back(
    command: Cli, tmp_path: Path, file: Path
) -> None:
    ran = command("config", file)
    assert ran.code == 0, ran.err
    again = tmp_path / "again.yaml"
    again.write_text(ran.out)
    assert load_vehicle(again) == load_vehicle(file)


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_every_camera_and_link_of_a_shipped_file_is_said(command: Cli, file: Path) -> None:
    vehicle = load_vehicle(file)
    keys = {f"cameras.{name}" for name in vehicle.cameras}
    keys |= {f"telemetry.devices.{name}.link" for name in vehicle.telemetry.devices}
    keys |= {"service.dives", "service.health"}
    shown = command("config", file, "--json")
    assert keys <= {each["name"] for each in json.loads(shown.out)["opens"]}
    asked = command("doctor", "--config", file, "--json")
    assert keys <= {each["name"] for each in json.loads(asked.out)["findings"]}
    assert all(key in command("doctor", "--config", file).out for key in keys)


@pytest.mark.parametrize(
    ("written", "key"),
    [
        ({"cameras": {"front": {"kind": "v4l2", "fsp": 3}}}, "cameras.front.v4l2.fsp"),
        ({"viewer": {"port": -1}}, "viewer.port"),
        ({"mapping": {"max_gausians": 3}}, "mapping.max_gausians"),
        ({"camera": {}}, "camera"),
        ({"cameras": [1]}, "cameras"),
        ({"telemetry": {"devices": {"a": {"kind": "ping"}}}}, "telemetry.devices.a.ping.link"),
    ],
)
@pytest.mark.parametrize("words", [("config",), ("doctor", "--config")])
def test_a_wrong_file_is_one_sentence_with_the_path_of_the_key(
    command: Cli, tmp_path: Path, written: dict[str, object], key: str, words: tuple[str, ...]
) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(yaml.safe_dump(written))
    ran = command(*words, file)
    refused(ran, file)
    assert f"'{key}'" in ran.err


def findings(tmp_path: Path, written: dict[str, object]) -> dict[str, tuple[str, bool]]:
    """By key, what was found on a machine of files below ``tmp_path``, and whether it is usable."""
    file = tmp_path / "vehicle.yaml"
    file.write_text(yaml.safe_dump(written))
    machine = MachineProbes(root=tmp_path)
    return {each.name: (each.found, each.ok) for each in check_opened(load_any(file), machine)}


def test_files_and_folders_that_are_not_there_are_said(tmp_path: Path) -> None:
    (tmp_path / "a_file").write_text("x")
    absent = str(tmp_path / "absent")
    found = findings(tmp_path, {
        "source": {"mask": absent},
        "prior": {"kind": "folder", "folder": absent},
        "cameras": {"front": {"kind": "stream", "url": "rtsp://host/a", "calibration": absent}},
        "service": {
            "dives": str(tmp_path / "a_file" / "dives"),
            "dive": {"site": absent},
            "health": {"port": 8230, "token_file": absent},
        },
    })  # fmt: skip
    for key in (
        "source.mask", "prior.folder", "cameras.front.calibration", "service.dives",
        "service.dive.site", "service.health.token_file",
    ):  # fmt: skip
        assert not found[key][1], key
    assert found["cameras.front"][1]


def test_devices_are_looked_for_by_their_names(tmp_path: Path) -> None:
    for name in ("dev/v4l/by-id/usb-camera-index0", "dev/ttyUSB0"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    ports = {
        name: {"kind": "ping", "link": {"kind": "serial", "port": f"/dev/{name}"}}
        for name in ("ttyUSB0", "ttyUSB1")
    }
    found = findings(tmp_path, {
        "cameras": {
            "there": {"kind": "v4l2", "device": "usb-camera-index0"},
            "gone": {"kind": "v4l2", "device": "usb-other-index0"},
        },
        "telemetry": {"devices": ports},
        "service": {"dives": str(tmp_path), "camera": "lost"},
    })  # fmt: skip
    assert found["cameras.there"] == ("/dev/v4l/by-id/usb-camera-index0", True)
    assert found["cameras.gone"] == ("not found; there: usb-camera-index0", False)
    assert found["telemetry.devices.ttyUSB0.link"] == ("there", True)
    assert found["telemetry.devices.ttyUSB1.link"] == ("not there", False)
    assert found["service.dives"] == ("there", True)
    assert not found["service.camera"][1]


def test_a_port_that_another_program_has_is_said(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        link = {"kind": "udp", "host": "127.0.0.1", "port": other.getsockname()[1]}
        written: dict[str, object] = {
            "telemetry": {"devices": {"autopilot": {"kind": "mavlink", "link": link}}}
        }
        assert not findings(tmp_path, written)["telemetry.devices.autopilot.link"][1]
    assert findings(tmp_path, written)["telemetry.devices.autopilot.link"] == ("free", True)


def test_a_password_of_a_stream_is_not_shown(tmp_path: Path) -> None:
    file = tmp_path / "vehicle.yaml"
    url = "rtsp://user:hidden@host:554/a"
    file.write_text(yaml.safe_dump({"cameras": {"front": {"kind": "stream", "url": url}}}))
    assert not any("hidden" in str(each) for each in check_opened(load_any(file)))
