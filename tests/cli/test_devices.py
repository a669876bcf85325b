"""``aquaflow doctor devices``: what is plugged in, and the lines that make a config use it."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from typer.testing import CliRunner

from aquaflow.cli import app
from aquaflow.cli.doctor import devices
from aquaflow.config.cameras import OakConfig, V4l2Config
from aquaflow.config.link import CanConfig, SerialConfig
from aquaflow.drivers import discovery as drivers
from aquaflow.recordings.images import ImageFolder
from aquaflow.sim_drivers.camera_feed import CameraFeed
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


def hanging() -> list[FoundDevice]:
    threading.Event().wait()
    return []


def asked(hosts: Sequence[str]) -> list[FoundDevice]:
    return [FoundDevice("stream", host, "Camera", "H.264") for host in hosts]


def registered(**groups: list[str]) -> Callable[..., list[EntryPoint]]:
    """Drivers of this module in place of the installed ones."""

    def entries(*, group: str) -> list[EntryPoint]:
        names = groups.get(group.removeprefix("aquaflow."), [])
        return [EntryPoint(name, f"{__name__}:{name}", group) for name in names]

    return entries


def test_a_driver_that_fails_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    drivers_here = registered(discovery=["working", "broken", "missing"])
    monkeypatch.setattr(discovery, "entry_points", drivers_here)
    found = discover()
    assert found.devices == working()
    assert found.problems[0] == "broken: the bus is on fire"
    assert found.problems[1].startswith("missing: ")


def test_a_driver_that_hangs_is_left_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    drivers_here = registered(discovery=["working", "hanging"])
    monkeypatch.setattr(discovery, "entry_points", drivers_here)
    assert discover(patience_s=0.2) == DiscoveryResult(working(), ["hanging: it did not end"])


def test_hosts_are_asked_by_the_drivers_of_the_network_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drivers_here = registered(discovery=["working"], network_discovery=["asked"])
    monkeypatch.setattr(discovery, "entry_points", drivers_here)
    assert discover(["10.0.0.2"]).devices == [*working(), *asked(["10.0.0.2"])]
    assert discover([]).devices == working()


def test_what_pyproject_registers_is_there() -> None:
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    for group in (discovery.DISCOVERY, discovery.NETWORK_DISCOVERY):
        _, _, block = text.partition(f'[project.entry-points."{group}"]\n')
        lines = block.partition("\n\n")[0].splitlines()
        assert len(lines) >= 4
        for line in lines:
            name, _, value = line.partition(" = ")
            assert callable(EntryPoint(name, value.strip('"'), group).load())


@pytest.mark.parametrize(
    ("options", "hosts"),
    [
        ((), discovery.VEHICLE_HOSTS),
        (("--local",), ()),
        (("--host", "a", "--host", "b"), ("a", "b")),
    ],
)
def test_the_options_say_who_is_asked(
    options: tuple[str, ...], hosts: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = []

    def look(hosts: Sequence[str]) -> DiscoveryResult:
        given.append(hosts)
        return DiscoveryResult([], [])

    monkeypatch.setattr(discovery, "discover", look)
    words = ["doctor", "devices", *options, "--json"]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert given == [hosts]


def test_what_cannot_be_used_now_has_no_lines_to_paste(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = FoundDevice("stream", "udp://0.0.0.0:5600", "UDP port 5600", "another program listens")
    monkeypatch.setattr(discovery, "discover", lambda hosts: DiscoveryResult([taken], []))
    devices()
    printed = capsys.readouterr().out
    assert "another program listens" in printed
    assert "{}" not in printed


def test_the_table_shows_ids_and_lines_for_the_config(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        discovery, "discover", lambda hosts: DiscoveryResult(working(), ["oak: no library"])
    )
    devices()
    printed = capsys.readouterr().out
    for part in ("Camera [1]", "abc", "kind: v4l2", "device: abc", "Not looked for: oak: no lib"):
        assert part in printed


def test_nothing_plugged_in_is_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(discovery, "discover", lambda hosts: DiscoveryResult([], []))
    devices()
    assert capsys.readouterr().out.startswith("Nothing was found: ")


def test_this_machine_is_looked_at_without_an_error(aquaflow: Cli) -> None:
    ran = aquaflow("doctor", "devices", "--local", "--json")
    assert ran.code == 0
    assert ran.err == ""
    found = json.loads(ran.out)
    assert set(found) == {"devices", "problems"}
    assert found["problems"] == []
