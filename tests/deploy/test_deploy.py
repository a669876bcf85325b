"""The files in deploy/, as far as they can be looked at without a vehicle."""

from __future__ import annotations

import re
import shutil
import subprocess
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from aquaflow.config.vehicle import load_vehicle
from aquaflow.drivers.discovery import SERIAL_PORTS

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
MOST_EXPOSED = 2.0
SCRIPTS = sorted(DEPLOY.rglob("*.sh"))


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """The unit with a program that is there."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    text = (DEPLOY / "aquaflow.service").read_text()
    file = tmp_path / "aquaflow.service"
    file.write_text(re.sub(r"^ExecStart=.*$", "ExecStart=/bin/true", text, flags=re.MULTILINE))
    return file


def test_systemd_has_nothing_to_say_about_the_unit(unit: Path) -> None:
    ran = subprocess.run(
        ["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, check=False
    )
    assert (ran.returncode, ran.stderr) == (0, "")


def test_the_unit_is_hardly_exposed(unit: Path) -> None:
    ran = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", str(unit)],
        capture_output=True,
        text=True,
        check=False,
    )
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", ran.stdout)
    assert found is not None, ran.stderr
    assert float(found[1]) <= MOST_EXPOSED


PROC_DEVICES = {
    "Raspberry Pi OS": """Character devices:
  4 ttyS
 81 video4linux
189 usb_device
204 ttyAMA
226 drm
237 media
""",
    "arm64 with drivers of many boards": """Character devices:
  4 ttyS
166 ttyACM
188 ttyUSB
204 ttySC
204 ttyAMA
240 ttyTHS
""",
}
"""Of such kernels, the lines that matter here."""


def allowed_groups() -> list[str]:
    """Device groups of the unit, which systemd looks up in /proc/devices by glob."""
    text = (DEPLOY / "aquaflow.service").read_text()
    return re.findall(r"^DeviceAllow=char-(\S+) rw$", text, flags=re.MULTILINE)


@pytest.mark.parametrize("pattern", SERIAL_PORTS)
def test_every_serial_port_that_is_listed_may_be_opened_by_the_service(pattern: str) -> None:
    name = pattern.removesuffix("*")
    assert any(fnmatchcase(name, group) for group in allowed_groups())


def udev_rules() -> list[dict[str, str]]:
    """Of each rule, the value of every key with its operator, such as ``GROUP=`` (udev(7))."""
    lines = (DEPLOY / "99-aquaflow.rules").read_text().splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    token = re.compile(r'([A-Z_]+(?:\{\w+\})?)(==|!=|\+=|-=|:=|=)"([^"]*)"')
    for rule in rules:
        assert re.fullmatch(rf"{token.pattern}(, {token.pattern})*", rule), rule
    return [{key + sign: value for key, sign, value in token.findall(rule)} for rule in rules]


def test_no_rule_takes_a_device_from_who_has_it() -> None:
    for rule in udev_rules():
        assert not {"GROUP=", "GROUP:=", "OWNER=", "OWNER:=", "MODE:="} & set(rule)
        assert rule.get("MODE=", "0666") == "0666"


def test_only_autopilots_are_kept_from_modemmanager() -> None:
    ignored = [rule for rule in udev_rules() if "ENV{ID_MM_DEVICE_IGNORE}=" in rule]
    assert ignored
    assert all("ATTRS{idVendor}==" in rule for rule in ignored)


def test_the_services_user_is_in_the_groups_that_udev_gives_devices_to() -> None:
    text = (DEPLOY / "install.sh").read_text()
    groups = re.search(r"for group in ([\w ]+); do", text)
    assert groups is not None
    # Those of systemd's 50-udev-default.rules for video4linux and media, drm and serial ports.
    assert {"video", "render", "dialout"} <= set(groups[1].split())


def test_udev_has_nothing_to_say_about_the_rules() -> None:
    udevadm = shutil.which("udevadm")
    if udevadm is None:
        pytest.skip("udevadm is not installed")
    command = [udevadm, "verify", str(DEPLOY / "99-aquaflow.rules")]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    if "Unknown command" in ran.stderr:
        pytest.skip("this udevadm is older than 254 and verifies nothing")
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.parametrize("listed", PROC_DEVICES.values(), ids=PROC_DEVICES)
def test_the_units_names_are_those_of_the_kernel(listed: str) -> None:
    kernel = set(re.findall(r"^ *\d+ (\S+)$", listed, flags=re.MULTILINE))
    used = {name for name in kernel if name.startswith(("tty", "video", "media", "usb"))}
    refused = {
        name for name in used if not any(fnmatchcase(name, each) for each in allowed_groups())
    }
    assert refused <= {"ttySC"}  # of another maker's board


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_scripts_parse_and_stop_at_the_first_error(script: Path) -> None:
    subprocess.run(["bash", "-n", str(script)], check=True)
    # These two are read by the others, under their settings.
    assert script.name in {"torch.sh", "device.sh"} or "set -euo pipefail" in script.read_text()


def test_an_interpreter_that_the_sandbox_hides_is_refused(tmp_path: Path) -> None:
    python = tmp_path / "python3"
    python.write_text(
        "#!/bin/bash\n[[ $2 == *base_prefix* ]] && echo /root/.pyenv/versions/3.11.7\n"
        "[[ $2 == *calcsize* ]] && echo x86_64 64\nexit 0\n"
    )
    python.chmod(0o755)
    command = [str(DEPLOY / "install.sh"), "--python", str(python), "--root", str(tmp_path)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 1
    assert "cannot reach" in ran.stderr or "run me as root" in ran.stderr
    assert not (tmp_path / "opt").exists()


@pytest.mark.parametrize("file", sorted((DEPLOY / "config").glob("*.yaml")), ids=lambda f: f.name)
def test_example_configs_are_valid(file: Path) -> None:
    assert load_vehicle(file).cameras
