"""A whole dive whose map is drawn and optimised by wgpu, here on Mesa's software adapter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from aquaflow.config import Config
from aquaflow.config.presets import merge
from aquaflow.dive.replay import map_recording
from aquaflow.sources import open_recording
from tests.device.whole_dives import FEW_STEPS, write_dimmed_dive
from tests.render.lost_device import lose_after
from tests.render.render_scenes import needs_adapter, needs_compiler

pytestmark = [needs_adapter, needs_compiler, pytest.mark.ci]

STEPS = merge(FEW_STEPS, {"optimiser": {"refine_steps": 30, "prune_every": 20}})


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dimmed_dive(tmp_path_factory.mktemp("dimmed"))


def metrics_of(recording: Path, renderer: str, folder: Path) -> dict[str, Any]:
    settings = {"threads": 1, "mapping": merge(STEPS, {"renderer": renderer})}
    source = open_recording(recording)
    return map_recording(source, "small", folder, Config.model_validate(settings)).metrics


def test_a_dive_on_wgpu_is_that_of_the_processor(recording: Path, tmp_path: Path) -> None:
    wanted = metrics_of(recording, "cpu", tmp_path / "cpu")
    found = metrics_of(recording, "wgpu", tmp_path / "wgpu")
    assert found["renderer"].startswith("wgpu (")
    assert found["psnr"] == pytest.approx(wanted["psnr"], abs=0.1)
    assert found["tracked"] == wanted["tracked"] == found["frames"]
    assert found["steps"] == wanted["steps"]
    assert found["transfers"]["wgpu bytes up"] > found["transfers"]["wgpu bytes down"] > 0
    assert found["gaussians"] == pytest.approx(wanted["gaussians"], rel=0.02)


def test_a_dive_whose_gpu_is_lost_while_it_refines_is_whole(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = metrics_of(recording, "cpu", tmp_path / "cpu")
    count = lose_after(monkeypatch, 60, "submit")
    monkeypatch.setattr("aquaflow.mapping.gpu_steps.SAVE_EVERY", 5)  # of 30 steps of refining
    found = metrics_of(recording, "wgpu", tmp_path / "lost")
    assert count() == 61
    assert found["renderer"].startswith("cpu (")
    assert found["complete"]
    # Four of thirty steps may be lost, where the map is still improving fast.
    assert found["psnr"] == pytest.approx(wanted["psnr"], abs=1.0)
