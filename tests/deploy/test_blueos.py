"""The BlueOS extension: its labels, its page's place in the menu, its first start."""

from __future__ import annotations

import http.client
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError

from aquaflow.config.service import ListenConfig
from aquaflow.config.vehicle import VehicleConfig, load_vehicle
from aquaflow.drivers.discovery import SERIAL_PORTS
from aquaflow.live.health.http import HealthServer
from aquaflow.sim_drivers.devices.ardusub import ArduSub
from aquaflow.sim_drivers.devices.wires import TcpWire
from aquaflow.types import Attitude, Depth
from tests.deploy.blueos_models import ExtensionVersion, ServiceMetadata, manifest_entry
from tests.deploy.dockerfile import instructions, labels_of
from tests.drivers.simulated_links import Rig, motion, running, until

BLUEOS = Path(__file__).resolve().parents[2] / "deploy" / "blueos"
DOCKERFILE = (BLUEOS / "Dockerfile").read_text()
LINUX_MAJORS = {
    "video4linux": 81, "ttyUSB": 188, "ttyACM": 166, "ttyAMA": 204, "usb_device": 189,
}  # fmt: skip
"""Linux, Documentation/admin-guide/devices.txt. ttyTHS has no fixed number."""


@pytest.fixture(scope="module")
def entry() -> ExtensionVersion:
    return manifest_entry(labels_of(DOCKERFILE))


@pytest.fixture(scope="module")
def config() -> VehicleConfig:
    return load_vehicle(BLUEOS / "aquaflow.yaml")


# --- the store ------------------------------------------------------------------------------------


def test_the_store_takes_the_labels_also_with_a_publisher_s_own_addresses() -> None:
    mine = {
        "CONTACT": "me@example.org",
        "WEBSITE": "https://example.org/a",
        "README": "https://example.org/{tag}/README.md",
    }
    entry = manifest_entry(labels_of(DOCKERFILE, mine))
    assert entry.authors[0].email == entry.company.email == "me@example.org"
    assert entry.support == "mailto:me@example.org"
    assert entry.website == "https://example.org/a"
    assert entry.readme == f"https://example.org/{entry.version}/README.md"


@pytest.mark.parametrize(
    ("label", "broken"),
    [
        ("authors", '[{"name": "AquaFlow contributors"}]'),
        ("authors", "[]"),
        ("company", '{"about": "maps"}'),
        ("links", "{}"),
        ("links", '{"website": "https://a.b", "documentation": "https://a.b/docs"}'),
        ("tags", '["Sea Floor"]'),
        ("type", "mapping"),
        ("version", "1.0"),
        ("permissions", '{"HostConfig": {"Bind": []}}'),
        ("permissions", '{"HostConfig": {"DeviceCgroupRules": ["c 81 rmw"]}}'),
        ("permissions", '{"HostConfig": {"Memory": "2G"}}'),
    ],
)
def test_the_model_of_the_store_rejects_what_the_store_rejects(label: str, broken: str) -> None:
    with pytest.raises((ValidationError, ValueError)):
        manifest_entry(labels_of(DOCKERFILE) | {label: broken})


def test_the_version_is_the_one_of_the_release(entry: ExtensionVersion) -> None:
    citation = yaml.safe_load((BLUEOS.parents[1] / "CITATION.cff").read_text())
    assert entry.version == citation["version"]


def test_labels_are_read_as_docker_reads_them() -> None:
    text = r"""
FROM a
ARG WHO=first
LABEL lost='1'
FROM b
ARG WHO=me
# a comment
LABEL one='{\
  "a": 1,\
# left out
  "b": "'$WHO'"\
}' two="x ${WHO} \"q\""
"""
    labels = labels_of(text)
    assert json.loads(labels["one"]) == {"a": 1, "b": "me"}
    assert labels["two"] == 'x me "q"'
    assert labels_of(text, {"WHO": "you"})["two"] == 'x you "q"'
    assert set(labels) == {"one", "two"}


# --- what the container may -----------------------------------------------------------------------


def test_the_container_has_the_vehicle_s_network_and_never_its_privileges(
    entry: ExtensionVersion,
) -> None:
    """CAN is a network interface; a container's own network has none, and no 127.0.0.1 of
    BlueOS's."""
    host = entry.permissions.HostConfig
    assert host.NetworkMode == "host"
    assert host.PortBindings == {}  # Docker leaves them out there
    assert not host.Privileged
    assert host.CpuQuota <= 2 * host.CpuPeriod
    assert 0 < host.Memory <= 2 << 30


def test_the_devices_of_the_drivers_can_be_opened(entry: ExtensionVersion) -> None:
    host = entry.permissions.HostConfig
    allowed = {int(rule.split()[1].partition(":")[0]) for rule in host.DeviceCgroupRules}
    assert allowed == set(LINUX_MAJORS.values())
    kinds = {pattern.rstrip("*") for pattern in SERIAL_PORTS} - {"ttyTHS"}
    assert kinds <= set(LINUX_MAJORS)
    assert "/dev:/dev" in host.Binds


def test_ports_folder_and_user_are_the_same_everywhere(
    entry: ExtensionVersion, config: VehicleConfig
) -> None:
    ports = {f"{config.service.health.port}/tcp", f"{config.viewer.port}/tcp"}
    assert set(entry.permissions.ExposedPorts) == ports
    exposed = [words.split() for name, words in instructions(DOCKERFILE) if name == "EXPOSE"]
    assert set(exposed[0]) == ports
    folders = [bind.split(":")[1] for bind in entry.permissions.HostConfig.Binds]
    for file in (config.service.dives, config.service.health.token_file, config.viewer.token_file):
        assert any(Path(folder) in Path(str(file)).parents for folder in folders)


# --- the menu -------------------------------------------------------------------------------------


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """Of the page as the extension serves it: with a token."""
    token = tmp_path / "token"
    token.write_text("correct-horse-battery")
    token.chmod(0o600)
    settings = ListenConfig.model_construct(host="127.0.0.1", port=0, token_file=token)
    server = HealthServer(settings, dict)
    yield server.port
    server.close()


def helper_asks(port: int, path: str) -> tuple[int, str]:
    """As BlueOS's helper does, which has no token."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", path, headers={"User-Agent": "python", "Accept": "*/*"})
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer.status, body


def test_blueos_finds_the_page_and_lists_it(port: int) -> None:
    status, page = helper_asks(port, "/")
    assert status == 200
    assert re.search(r"<title>(.*?)</title>", page)[1] == "AquaFlow"  # type: ignore[index]
    status, said = helper_asks(port, "/register_service")
    assert status == 200
    listed = ServiceMetadata.model_validate(json.loads(said))
    assert re.sub("[^a-z0-9]", "", listed.name.lower()) == "aquaflow"
    for path in ("/docs", "/v1.0/ui/"):  # looked for too; anything but 200 means: none
        assert helper_asks(port, path)[0] != 200


def test_every_address_of_the_page_holds_under_the_path_that_blueos_gives_it(port: int) -> None:
    _, page = helper_asks(port, "/")
    scripts = "".join(
        helper_asks(port, f"/page/{name}.js")[1] for name in ("page", "plan", "words")
    )
    addresses = re.findall(r'(?:href|src|action)="([^"]*)"', page)
    addresses += re.findall(r"""(?:ask|fetch)\(["`']([^"`']*)""", scripts)
    assert {"health", "path.json", "login", "page/page.js"} <= set(addresses)
    assert not [address for address in addresses if address.startswith(("/", "http"))]


# --- the autopilot --------------------------------------------------------------------------------


def test_the_autopilot_is_heard_and_answered_by_the_endpoint_that_blueos_always_has(
    tmp_path: Path,
) -> None:
    """Its MAVLink router serves "Internal Link", TCP 127.0.0.1:5777, and lets nobody remove it."""
    devices = yaml.safe_load((BLUEOS / "aquaflow.yaml").read_text())["telemetry"]["devices"]
    link = devices["autopilot"]["link"]
    assert (link["kind"], link["host"], link["port"]) == ("tcp", "127.0.0.1", 5777)
    wire, autopilot = TcpWire(), ArduSub()
    rig = Rig(
        autopilot, wire, devices["autopilot"] | {"link": link | {"port": wire.port}}, frozenset()
    )
    with running(rig, motion()) as session:
        session.play()
        until(lambda: session.counters.messages >= session.device.sent)
        until(lambda: autopilot.heartbeats > 0)
        heard = {type(sample) for sample in session.fetched()}
    assert {Depth, Attitude} <= heard


# --- the start ------------------------------------------------------------------------------------


FAKES = {
    "install": 'args=(); while (($#)); do case $1 in -o|-g) shift;; *) args+=("$1");; esac; '
    'shift; done; exec /usr/bin/install "${args[@]}"',
    "chown": "exit 0",
    "setpriv": 'while [[ $1 != /* ]]; do shift; done; echo "as user: $(basename "$1") ${*:2}"',
}
"""Commands that need root, or a user who is not there."""


@pytest.fixture
def start(tmp_path: Path) -> Callable[[], str]:
    """The start script with its folders in ``tmp_path``; what it prints."""
    share = tmp_path / "opt" / "share"
    for folder in (share, tmp_path / "opt" / "bin", tmp_path / "fakes"):
        folder.mkdir(parents=True)
    (share / "aquaflow.yaml").write_bytes((BLUEOS / "aquaflow.yaml").read_bytes())
    fakes = {tmp_path / "fakes" / name: body for name, body in FAKES.items()}
    fakes[tmp_path / "opt" / "bin" / "python"] = f'exec "{sys.executable}" "$@"'
    for file, body in fakes.items():
        file.write_text(f"#!/bin/bash\n{body}\n")
        file.chmod(0o755)
    text = (BLUEOS / "start.sh").read_text()
    text = text.replace("/opt/aquaflow", str(tmp_path / "opt"))
    text = re.sub(r"(?<![\w/])/data\b", str(tmp_path / "data"), text)

    def run() -> str:
        path = f"{tmp_path / 'fakes'}:{os.environ['PATH']}"
        ran = subprocess.run(
            ["bash", "-c", text], capture_output=True, text=True, check=True, env={"PATH": path}
        )
        return ran.stdout

    return run


def test_the_first_start_makes_config_and_token_and_says_where(
    start: Callable[[], str], tmp_path: Path
) -> None:
    said = start()
    token = tmp_path / "data" / "token"
    assert len(token.read_text().strip()) >= 16
    assert token.stat().st_mode & 0o777 == 0o600
    assert token.read_text().strip() in said
    assert "/usr/blueos/extensions/aquaflow/token" in said
    assert "as user: aquaflow doctor devices" in said
    assert said.splitlines()[-1].startswith("as user: aquaflow run --config")


def test_a_later_start_keeps_both_and_closes_what_an_editor_left_open(
    start: Callable[[], str], tmp_path: Path
) -> None:
    start()
    token, config = tmp_path / "data" / "token", tmp_path / "data" / "aquaflow.yaml"
    token.write_text("my-own-long-token-1\n")
    token.chmod(0o644)
    config.write_text("cameras: {}\n")
    assert "my-own-long-token-1" in start()
    assert token.stat().st_mode & 0o777 == 0o600
    assert config.read_text() == "cameras: {}\n"
