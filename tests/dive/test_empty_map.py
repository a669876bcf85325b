"""A map that ends with 0 Gaussians: one sentence says so, and the exit status is not 0."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from aquaflow.config import Config
from aquaflow.dive.run import shortcomings
from aquaflow.lab.bench.job import BenchJob
from aquaflow.lab.bench.runner import in_process
from aquaflow.lab.bench.scene import BenchmarkScene
from tests.command_line import run_aquaflow

THE_PAPERS = {"mapping": {"insertion": {"tau_a": 1.0}, "medium": {"fit": False}}}
"""P_a is at most 1, so that nothing is above."""
SAID = (
    "the map is empty: it ends with 0 Gaussians; mapping.insertion.tau_a is 1.0, by default 0.02: "
    "set it back"
)


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    file = tmp_path / "config.yaml"
    file.write_text(json.dumps(THE_PAPERS))
    return file


def test_mapping_says_so(settings: Path, small_recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "dive"
    ran = run_aquaflow("map", small_recording, "--config", settings, "--stop", 12, "--out", out)
    assert ran.code == 3
    assert f"Warning: {SAID}.\n" in ran.out
    assert json.loads((out / "metrics.json").read_text())["gaussians"] == 0


@pytest.mark.ci
def test_a_live_run_says_so(settings: Path, small_recording: Path, tmp_path: Path) -> None:
    vehicle = json.loads(settings.read_text()) | {
        "service": {"health": {"enabled": False, "port": 8230}}
    }
    settings.write_text(json.dumps(vehicle))
    ran = run_aquaflow(
        "run", "--config", settings, "--source", small_recording, "--out", tmp_path / "dive"
    )
    assert ran.code == 3
    assert f"Warning: {SAID}.\n" in ran.out


@pytest.mark.slow
def test_a_benchmark_counts_it_as_failed(small_recording: Path, tmp_path: Path) -> None:
    scene = BenchmarkScene("reef", str(small_recording), refine_share=0.01)
    row = in_process(BenchJob(scene, "balanced", str(tmp_path / "dive"), overrides=THE_PAPERS))
    assert row["failed"] == f"reef: {SAID}"


def test_pruning_that_leaves_nothing_is_named() -> None:
    config = Config.model_validate({"mapping": {"optimiser": {"prune_opacity": 0.99}}})
    (sentence,) = shortcomings(config, [], 0)
    assert "mapping.optimiser.prune_opacity is 0.99, by default 0.02: set it back" in sentence


def test_a_trajectory_alone_lacks_no_map() -> None:
    config = Config.model_validate({"mapping": {"enabled": False}})
    assert shortcomings(config, [], 0) == []
