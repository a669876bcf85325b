"""Every optional package is named: its version, what it is for, and what installs it."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from aquaflow.doctor import MachineProbes
from aquaflow.doctor.computer import INSTALLED_OTHERWISE, OTHER_BUILDS, PACKAGES, findings

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
FOR_DEVELOPERS = {"dev", "docs", "s3-tests"}
HEAVY = ("depthai", "onnxruntime", "gsplat", "pymavlink.mavutil", "torch")


def names(requirements: list[str]) -> set[str]:
    found = (re.match(r"[\w.-]+", each) for each in requirements)
    return {match[0] for match in found if match is not None}


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    described: dict[str, Any] = tomllib.loads(PROJECT.read_text())["project"]
    return described


def test_every_package_of_every_extra_is_known_and_no_other(project: dict[str, Any]) -> None:
    always = names(project["dependencies"])
    other_builds = {build for builds in OTHER_BUILDS.values() for build in builds}
    optional = {
        (name, extra)
        for extra, requirements in project["optional-dependencies"].items()
        if extra not in FOR_DEVELOPERS
        for name in names(requirements) - always - other_builds
    }
    assert {(each.distribution, each.extra) for each in PACKAGES} == optional


def test_a_package_that_is_there_is_named_with_its_version() -> None:
    machine = MachineProbes(
        module_present=lambda name: True,
        version={"pymavlink": "2.4.50", "onnxruntime-gpu": "1.31.1"}.get,
    )
    found = {finding.name.removeprefix("package "): finding for finding in findings(machine)}
    assert found["pymavlink"].found == "2.4.50"
    assert found["pymavlink"].ok
    assert "autopilots" in found["pymavlink"].used_for
    assert found["onnxruntime"].found == "1.31.1"  # the other build of the same module
    assert found["rosbags"].found == "of unknown version"


def test_a_package_that_is_missing_says_what_installs_it(project: dict[str, Any]) -> None:
    missing = findings(MachineProbes(module_present=lambda name: False))
    for package, finding in zip(PACKAGES, missing, strict=True):
        assert finding.name == f"package {package.distribution}"
        assert finding.found == "not installed"
        if package.distribution in INSTALLED_OTHERWISE:
            assert INSTALLED_OTHERWISE[package.distribution] in finding.advice
        else:
            extra = re.search(r"'aquaflow\[([\w-]+)\]'", finding.advice)
            assert extra is not None
            requirements = project["optional-dependencies"][extra[1]]
            assert package.distribution in names(requirements)


def test_what_is_installed_here_is_found_by_its_module() -> None:
    found = {finding.name: finding.found for finding in findings(MachineProbes())}
    for name in ("pymavlink", "pyserial", "python-can", "mcap-protobuf-support"):
        assert found[f"package {name}"] == version(name)


def test_nothing_heavy_is_imported() -> None:
    program = (
        "import sys; from aquaflow.doctor.computer import findings; "
        "from aquaflow.doctor import MachineProbes; findings(MachineProbes()); "
        f"print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert ran.stdout == "[]\n"
