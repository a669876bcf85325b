"""The service under real systemd as PID 1: install, READY, a hang, a kill, a stop, the way out."""

from __future__ import annotations

import compileall
import functools
import os
import shutil
import subprocess

import pytest

from tests.kernel.virtual_machine import GUEST, HERE, MACHINE, ROOT

DIVE = {"frames": 160, "width": 64, "height": 48}
"""As small as can be tracked, and long enough to be killed, resumed and stopped on the way."""
TIMEOUT_S = float(os.environ.get("AQUAFLOW_VM_TIMEOUT_S", "1800"))
"""Emulated: beside other work on both cores it takes about a third of it."""


@functools.cache
def results() -> tuple[dict[str, str], str]:
    """What the job in the guest said of each step, and the end of its console."""
    from aquaflow.lab.synthetic.config import SyntheticConfig
    from aquaflow.lab.synthetic.dive import write_dive

    shutil.rmtree(MACHINE / "recording", ignore_errors=True)
    write_dive(MACHINE / "recording", SyntheticConfig.model_validate(DIVE))
    # As pip does: the guest would take half a minute for it at each start.
    for package in ("aquaflow", "drivers"):
        compileall.compile_dir(ROOT / package, quiet=1)
    command = [str(HERE / "systemd_boot.sh"), str(MACHINE), str(HERE / "service_job.sh")]
    with (MACHINE / "systemd.log").open("wb") as log:
        limit = {"TIMEOUT_S": str(round(TIMEOUT_S))}
        subprocess.run(
            command, cwd=ROOT, env=os.environ | limit, stdout=log, stderr=log, check=False
        )
    console = (MACHINE / "systemd.log").read_text(errors="replace")
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
    assert step("installed") == "enabled"
    assert "waiting for camera" in step("ready")
    assert step("user") == "aquaflow dives 1"


@pytest.mark.kernel
def test_a_camera_that_comes_is_taken_beside_the_autopilot() -> None:
    assert "initialising" in step("camera")
    assert step("devices") == "front streaming autopilot connected"


@pytest.mark.kernel
def test_systemd_kills_a_planted_hang_and_starts_the_service_anew() -> None:
    assert step("watchdog") == "restarts 0, then hangs 1"
    step("restarted")


@pytest.mark.kernel
def test_a_killed_dive_is_resumed_in_its_own_folder_and_goes_on() -> None:
    step("checkpoint")
    assert step("resumed") == "new dives 0"
    step("continued")


@pytest.mark.kernel
def test_it_stops_cleanly_with_its_report_and_leaves_nothing_behind() -> None:
    assert step("stopped") == "success inactive checkpoint/state.npz metrics.json report.html"
    step("uninstalled")
