"""The fuzzer for an hour over every command; ``.ci/run`` runs it for two minutes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SECONDS = "AQUAFLOW_FUZZ_SECONDS"
"""Environment variable: how long to run."""


@pytest.mark.slow
def test_no_command_ends_in_a_traceback_hangs_or_leaves_half_a_file(tmp_path: Path) -> None:
    seconds = os.environ.get(SECONDS, "3600")
    asked = ["--seconds", seconds, "--seed", "1", "--keep", str(tmp_path / "finds")]
    # A process of its own: it forks, so nothing may have computed in threads before.
    ran = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", *asked],
        cwd=ROOT,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )
    print(ran.stdout)
    assert ran.returncode == 0, f"{ran.stdout[-20_000:]}\n{ran.stderr[-2000:]}"
