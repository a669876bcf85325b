"""``aquaflow devices``: what is plugged in, and the lines that make a config use it."""

from __future__ import annotations

import json
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from aquaflow.cli import devices
from aquaflow.config.cameras import OakConfig, V4l2Config
from aquaflow.config.link import CanConfig, SerialConfig
from aquaflow.drivers import discovery as drivers
from aquaflow.sim_drivers.camera_feed import CameraFeed
from aquaflow.sim_drivers.images import ImageFolder
from aquaflow.sim_drivers.v4l2_kernel import V4l2Kernel
from aquaflow.sources import discovery
from aquaflow.sources.discovery import DiscoveryResult, FoundDevice, discover
from tests.command_line import Cli


def put(root: Path, path: str, content: str = "") -> Path:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(content)
    return file


def test_a_camera_is_listed_once_with_a_config_that_finds_it(
    tmp_path: Path, small_recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = V4l2Kernel(tmp_path, CameraFeed(ImageFolder(small_recording)))
    monkeypatch.setattr("aquaflow.drivers.v4l2.system.Kernel", lambda: kernel)
    (found,) = drivers.v4l2_cameras(tmp_path)
    assert found.id == "usb-SIM0001-video-index0"
    assert found.name == "Simulated USB camera"
    assert found.detail.startswith("YUYV up to 160 x 120; MJPG")
    assert V4l2Config.model_validate(found.config).device == found.id


def test_an_oak_without_its_library_is_told_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drivers, "find_spec", lambda name: None)
    assert drivers.oak_cameras(tmp_path) == []
    put(tmp_path, "sys/bus/usb/devices/1-2/idVendor", "03e7\n")
    put(tmp_path, "sys/bus/usb/devices/1-3/idVendor", "046d\n")
    (found,) = drivers.oak_cameras(tmp_path)
    assert "pip install 'aquaflow[oak]'" in found.detail
    OakConfig.model_validate(found.config)


def test_serial_ports_are_listed_once_by_their_stable_name(tmp_path: Path) -> None:
    port = put(tmp_path, "dev/ttyACM0")
    put(tmp_path, "dev/ttyUSB3")
    link = tmp_path / "dev/serial/by-id/usb-Pixhawk"
    link.parent.mkdir(parents=True)
    link.symlink_to(port)
    found = drivers.serial_ports(tmp_path)
    assert [each.id for each in found] == ["/dev/serial/by-id/usb-Pixhawk", "/dev/ttyUSB3"]
    assert [each.detail for each in found] == ["now ttyACM0", "its number may change"]
    for each in found:
        assert SerialConfig.model_validate(each.config).port == each.id


def test_can_interfaces_are_told_from_ethernet(tmp_path: Path) -> None:
    for name, kind, state in (("eth0", "1", "up"), ("can0", "280", "down"), ("can1", "280", "up")):
        put(tmp_path, f"sys/class/net/{name}/type", kind)
        put(tmp_path, f"sys/class/net/{name}/operstate", state)
    found = drivers.can_interfaces(tmp_path)
    assert [each.id for each in found] == ["can0", "can1"]
    assert "sudo ip link set can0 up" in found[0].detail
    assert found[1].detail == "up"
    assert CanConfig.model_validate(found[1].config).channel == "can1"


def broken() -> list[FoundDevice]:
    raise OSError("the bus is on fire")


def working() -> list[FoundDevice]:
    return [FoundDevice("v4l2", "abc", "Camera [1]", "MJPG", {"kind": "v4l2", "device": "abc"})]


def test_a_driver_that_fails_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [EntryPoint(n, f"{__name__}:{n}", discovery.DISCOVERY) for n in ("working", "broken")]
    monkeypatch.setattr(discovery, "entry_points", lambda *, group: entries)
    assert discover() == DiscoveryResult(working(), ["broken: the bus is on fire"])


def test_the_table_shows_ids_and_lines_for_the_config(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        discovery, "discover", lambda: DiscoveryResult(working(), ["oak: no library"])
    )
    devices.devices()
    printed = capsys.readouterr().out
    for part in ("Camera [1]", "abc", "kind: v4l2", "device: abc", "Not looked for: oak: no lib"):
        assert part in printed


def test_nothing_plugged_in_is_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(discovery, "discover", lambda: DiscoveryResult([], []))
    devices.devices()
    assert capsys.readouterr().out == "No camera, serial port or CAN interface is plugged in.\n"


def test_this_machine_is_looked_at_without_an_error(aquaflow: Cli) -> None:
    ran = aquaflow("devices", "--json")
    assert ran.code == 0
    assert ran.err == ""
    found = json.loads(ran.out)
    assert set(found) == {"devices", "problems"}
    assert found["problems"] == []
