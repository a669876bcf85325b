"""The paper's preset on a CPU: slow, but a map comes out of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.command_line import run_aquaflow


@pytest.mark.ci
def test_the_papers_preset_maps_a_small_dive(small_recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "dive"
    options = ("--preset", "paper", "--stop", 12, "--refine-steps", 20, "--out", out)
    ran = run_aquaflow("map", small_recording, *options)
    assert ran.code == 0, ran.err
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["gaussians"] > 1000
    assert metrics["failures"] == []
    assert metrics["steps_undone"] == 0
