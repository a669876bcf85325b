"""The files in deploy/, as far as they can be looked at without a vehicle."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from aquaflow.config.vehicle import load_vehicle
from aquaflow.service.health.http import REGISTRATION

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
MOST_EXPOSED = 2.0
SCRIPTS = sorted(DEPLOY.glob("*.sh"))


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


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_scripts_parse_and_stop_at_the_first_error(script: Path) -> None:
    subprocess.run(["bash", "-n", str(script)], check=True)
    # torch.sh is read by the others, under their settings.
    assert script.name == "torch.sh" or "set -euo pipefail" in script.read_text()


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


def test_the_extension_has_the_labels_that_blueos_reads() -> None:
    import json

    text = (DEPLOY / "blueos" / "Dockerfile").read_text().replace("\\\n", "")
    labels = dict(re.findall(r"^LABEL (\w+)='(.*)'\s*$", text, flags=re.MULTILINE))
    assert {"version", "permissions", "authors", "company", "type", "readme", "links"} <= set(
        labels
    )
    permissions = json.loads(labels["permissions"])
    ((port, _),) = permissions["HostConfig"]["PortBindings"].items()
    assert port in permissions["ExposedPorts"]
    assert {"Memory", "CpuQuota"} <= set(permissions["HostConfig"])
    assert REGISTRATION["api"] == "/health"
    config = yaml.safe_load((DEPLOY / "blueos" / "aquaflow.yaml").read_text())
    assert config["service"]["health"]["token_file"]
