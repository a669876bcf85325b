"""A dive that is only tracked loads nothing of mapping: no torch, which takes 180 MB."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import sys
from typer.testing import CliRunner
from aquaflow.cli import app
ran = CliRunner().invoke(app, sys.argv[1:])
assert ran.exit_code == 0, ran.output
print("torch" in sys.modules, "aquaflow.mapping.mapper" in sys.modules)
"""


@pytest.mark.parametrize("more", [(), ("--realtime",)], ids=["replayed", "live"])
def test_a_dive_that_is_only_tracked_loads_no_torch(
    more: tuple[str, ...], small_recording: Path, tmp_path: Path
) -> None:
    arguments = ["map", str(small_recording), "--out", str(tmp_path / "dive"), "--tracking-only"]
    arguments += ["--stop", "8"]
    ran = subprocess.run(
        [sys.executable, "-c", CODE, *arguments, "--json", *more],
        capture_output=True, text=True, check=True, timeout=240,
    )  # fmt: skip
    assert ran.stdout.splitlines()[-1] == "False False"
    metrics = json.loads((tmp_path / "dive" / "metrics.json").read_text())
    assert metrics["tracked"] > 0
    assert metrics["gaussians"] == 0
    assert (metrics["renderer"], metrics["device"]) == (None, None)
    assert metrics["lpips_reason"] == "mapping is off"
