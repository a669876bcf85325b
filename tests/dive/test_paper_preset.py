"""The paper's presets on a CPU: slow, but a map comes out of each."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.command_line import run_aquaflow


@pytest.mark.ci
@pytest.mark.parametrize("preset", ["paper", "paper-strict"])
def test_the_papers_presets_map_a_small_dive(
    small_recording: Path, tmp_path: Path, preset: str
) -> None:
    out = tmp_path / "dive"
    options = ("--preset", preset, "--stop", 12, "--refine-steps", 20, "--out", out)
    ran = run_aquaflow("map", small_recording, *options)
    assert ran.code == 0, ran.err
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["gaussians"] > 1000
    assert metrics["failures"] == []
    assert metrics["steps_undone"] == 0
    if preset == "paper-strict":
        medium = json.loads((out / "medium.json").read_text())
        assert (medium["evidence"], medium["lamp"]) == (None, None)  # nothing was fitted
        assert not any(medium["shading_log_gain"] + medium["backscatter_log_gain"])
