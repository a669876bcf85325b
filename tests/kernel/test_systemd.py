"""The service under real systemd as PID 1: install, READY, a hang, a kill, a stop, the way out."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess

import pytest
from virtual_machine import GUEST, HERE, MACHINE, ROOT

FRAMES = 80
TIMEOUT_S = float(os.environ.get("AQUAFLOW_VM_TIMEOUT_S", "900"))
"""Emulated: on an idle machine a third of it."""


@functools.cache
def results() -> tuple[dict[str, str], str]:
    """What the job in the guest said of each step, and the end of its console."""
    recording = MACHINE / "recording"
    if not recording.exists():
        from aquaflow.synthetic import SyntheticConfig, write_dive

        write_dive(recording, SyntheticConfig(frames=FRAMES, width=128, height=96))
    command = [str(HERE / "systemd_boot.sh"), str(MACHINE), str(HERE / "service_job.sh")]
    ran = subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | {"TIMEOUT_S": str(round(TIMEOUT_S))},
        capture_output=True,
        check=False,
    )
    console = ran.stdout.decode(errors="replace")
    said = [line.split(" ", 2) for line in console.splitlines() if line.startswith("RESULT ")]
    return {words[1].strip(): (words[2:] or [""])[0].strip() for words in said}, console[-6000:]


def step(name: str) -> str:
    if GUEST:
        pytest.skip("this machine boots one of its own")
    for tool in ("qemu-system-x86_64", "busybox", "systemctl"):
        if shutil.which(tool) is None:
            pytest.skip(f"no {tool}; see tests/kernel/prepare.sh")
    if not (MACHINE / "version").is_file():
        pytest.skip(f"no kernel image in {MACHINE}: run `make test-kernel`")
    said, console = results()
    if name not in said:
        pytest.fail(f"the guest did not come to '{name}':\n{console}", pytrace=False)
    return said[name]


@pytest.mark.kernel
def test_the_installer_runs_and_the_service_is_ready_without_a_camera() -> None:
    step("installed")
    assert "waiting for camera" in step("ready")
    assert step("user") == "aquaflow dives 1"


@pytest.mark.kernel
def test_a_camera_that_comes_is_taken() -> None:
    assert "initialising" in step("camera")


@pytest.mark.kernel
def test_systemd_kills_a_planted_hang_and_starts_the_service_anew() -> None:
    assert int(step("watchdog")) >= 1
    step("restarted")


@pytest.mark.kernel
def test_a_killed_dive_is_resumed_in_its_own_folder() -> None:
    step("checkpoint")
    assert step("resumed") == "dives 1"


@pytest.mark.kernel
def test_it_stops_cleanly_and_leaves_nothing_behind() -> None:
    assert step("stopped") == "success inactive"
    step("uninstalled")
