"""Tests that run in a virtual machine; what is told on the host is what happened in it.

The machine boots once for all of them and runs this same folder with AQUAFLOW_GUEST set. On the
host each test then takes the result that its namesake had. `make test-kernel` prepares the machine.
"""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
MACHINE = ROOT / ".venv" / "cache" / "kernel"
GUEST = "AQUAFLOW_GUEST" in os.environ

MARK = "GUEST_RESULT "
TIMEOUT_S = 570.0


def in_guest(test: Callable[[], None]) -> Callable[[], None]:
    """Run ``test`` in the machine; it takes no fixtures."""
    name = f"{test.__module__}.{test.__name__}"

    @pytest.mark.kernel
    @functools.wraps(test)
    def run() -> None:
        if GUEST:
            tell(name, test)
        else:
            take_result(name)

    return run


def tell(name: str, test: Callable[[], None]) -> None:
    """In the guest: the result as one line on the console."""
    problem = ""
    try:
        test()
    except Exception:
        problem = traceback.format_exc()
        raise
    finally:
        print(f"\n{MARK}{json.dumps([name, problem])}", flush=True)


def take_result(name: str) -> None:
    """On the host: the guest's result."""
    if shutil.which("qemu-system-x86_64") is None:
        pytest.skip("no qemu: apt-get install qemu-system-x86; see tests/kernel/prepare.sh")
    if not (MACHINE / "version").is_file():
        pytest.skip(f"no kernel image in {MACHINE}: run `make test-kernel`")
    results, console = guest()
    if name not in results:
        pytest.fail(f"the guest did not come to this test:\n{console}", pytrace=False)
    if results[name]:
        pytest.fail(results[name], pytrace=False)


@functools.cache
def guest() -> tuple[dict[str, str], str]:
    """What went wrong in each test, and the end of the guest's console."""
    inside = [sys.executable, "-m", "pytest", str(HERE), "-m", "kernel", "-s", "-q"]
    options = ["-p", "no:cacheprovider", "--basetemp", "/dev/shm/pytest"]
    try:
        console = subprocess.run(
            [str(HERE / "boot.sh"), str(MACHINE), *inside, *options],
            cwd=ROOT,
            capture_output=True,
            timeout=TIMEOUT_S,
            check=False,
        ).stdout
    except subprocess.TimeoutExpired as error:
        console = error.stdout or b""
    text = console.decode(errors="replace")
    told = (line.partition(MARK) for line in text.splitlines())
    results = dict(json.loads(result) for _, mark, result in told if mark)
    return results, text[-4000:]
