"""The paper's network at its full size, with random weights: exported, verified, and at what cost.

Memory is tested; times are printed (``pytest -rP``) and recorded, not tested.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree

import pytest
import torch

from aquaflow.lab.networks.mast3r.export import OUTPUTS
from aquaflow.lab.networks.mast3r.network import FULL, Mast3r

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600), pytest.mark.usefixtures("onnxscript")]

pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")

GIVE_UP_S = 1700.0
"""Longest wait for a command that takes two minutes of an idle core."""
MOST_GB = 8.0
"""That either command may take; they took 5.5 and 5.3 (notes/2026-11-priors.md#fine-tuning)."""

MEASURED = """
import atexit, sys, time
from pathlib import Path
from aquaflow.cli import app

@atexit.register
def note() -> None:
    status = Path("/proc/self/status").read_text()
    peak_kb = int(status.split("VmHWM:")[1].split()[0])
    Path(sys.argv[1]).write_text(f"{peak_kb / 1024**2} {time.process_time()}")

app(sys.argv[2:])
"""
"""Not by getrusage, whose peak is that of the test's process where that was larger."""


@dataclass(frozen=True)
class Cost:
    """Of a command."""

    stdout: str
    peak_gb: float
    cpu_s: float
    wall_s: float


def measure(scratch: Path, *arguments: str | Path) -> Cost:
    began = time.monotonic()
    command = [sys.executable, "-c", MEASURED, str(scratch / "used"), *map(str, arguments)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=GIVE_UP_S, check=False)
    assert ran.returncode == 0, ran.stderr[-2000:]
    peak_gb, cpu_s = map(float, (scratch / "used").read_text().split())
    return Cost(ran.stdout, peak_gb, cpu_s, time.monotonic() - began)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Iterator[Path]:
    """2.8 GB, and as much for the prior beside it: gone after the test."""
    path = tmp_path / "random.pth"
    torch.manual_seed(0)
    torch.save({"model": Mast3r(FULL).state_dict()}, path)
    yield path
    rmtree(tmp_path)


def test_a_full_size_network_is_exported_and_verified_in_eight_gigabytes(
    checkpoint: Path, record_property: Callable[[str, object], None]
) -> None:
    scratch = checkpoint.parent
    prior = ("lab", "prior")
    made = ("--checkpoint", checkpoint)
    costs = {
        "export": measure(scratch, *prior, "export", "mast3r", *made, "--out", scratch / "prior"),
        "verify": measure(scratch, *prior, "verify", scratch / "prior", *made, "--json"),
    }
    for name, cost in costs.items():
        told = f"{cost.peak_gb:.1f} GB, {cost.cpu_s:.0f} s of CPU, {cost.wall_s:.0f} s"
        record_property(name, told)
        print(f"{name}: {told}")
        assert cost.peak_gb < MOST_GB, name
    outputs = {row["name"]: row["max_rel"] for row in json.loads(costs["verify"].stdout)["outputs"]}
    assert set(outputs) == {"tokens", *OUTPUTS}
    assert max(outputs.values()) <= 1e-4
