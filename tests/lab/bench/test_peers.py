"""Peers: a path they must find on a small dive, and their absence as a sentence."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from aquaflow.base.errors import AquaFlowError
from aquaflow.config import Config
from aquaflow.lab.bench.peers import run_peer
from aquaflow.lab.bench.peers.sequential_sfm import features_of
from aquaflow.lab.bench.scene import scene_at
from aquaflow.lab.evaluation.protocol import evaluate_dive


def test_two_view_odometry_roughly_recovers_the_path(small_recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "dive"
    metrics = run_peer("two-view", scene_at(small_recording), Config(), out)
    assert metrics["tracked"] == metrics["frames"] == 24
    assert metrics["ms_per_frame"]["p50"] > 0.0
    assert evaluate_dive(out, small_recording).error.sim3.pct < 8.0


@pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed"
)
def test_colmap_recovers_the_path(small_recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "dive"
    metrics = run_peer("colmap", scene_at(small_recording), Config(), out)
    assert metrics["tracked"] > 20
    assert metrics["features"].startswith("SIFT")
    assert metrics["ms_per_frame"]["p50"] is None
    assert evaluate_dive(out, small_recording).error.sim3.pct < 2.0


def test_colmap_says_which_features_and_matcher_it_ran_with() -> None:
    def options(kind: str) -> Callable[[], SimpleNamespace]:
        return lambda: SimpleNamespace(type=SimpleNamespace(name=kind))

    newest = SimpleNamespace(
        FeatureExtractionOptions=options("ALIKED_N32"),
        FeatureMatchingOptions=options("ALIKED_LIGHTGLUE"),
    )
    before = SimpleNamespace(
        FeatureExtractionOptions=SimpleNamespace, FeatureMatchingOptions=SimpleNamespace
    )
    assert features_of(newest) == "ALIKED_N32 matched by ALIKED_LIGHTGLUE"
    assert features_of(before) == features_of(SimpleNamespace()) == "SIFT"


def test_a_missing_peer_says_how_to_get_it(
    small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(AquaFlowError, match=r"not available: .*aquaflow\[peers\]"):
        run_peer("colmap", scene_at(small_recording), Config(), tmp_path / "dive")
