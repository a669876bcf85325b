"""What any library throws at any frame costs that frame or that step, never the dive.

A sample of the faults is `make test-injection`, which `.ci/run` calls.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def injection(*arguments: object, timeout_s: float) -> subprocess.CompletedProcess[str]:
    """The harness in a process of its own, which has imported nothing of ours yet."""
    environment = {key: value for key, value in os.environ.items() if key != "AQUAFLOW_STRICT"}
    return subprocess.run(
        [sys.executable, "-m", "tests.injection", *map(str, arguments)],
        cwd=ROOT, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False,
    )  # fmt: skip


@pytest.mark.slow
def test_every_fault_at_every_call_leaves_every_dive_whole() -> None:
    done = injection("--all", "--kinds", "raise", "nan", "full disk", timeout_s=8 * 3600.0)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_interrupts_and_full_memory_keep_their_own_ways() -> None:
    done = injection("--sample", 200, "--kinds", "interrupt", "memory", timeout_s=3600.0)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
