"""A whole dive whose map is drawn and optimised by wgpu, here on Mesa's software adapter."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from aquaflow.config import Config
from aquaflow.config.presets import merge
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.replay import map_recording
from aquaflow.live.checkpoint.resume import resume_folder
from aquaflow.live.live_dive import LiveDive
from aquaflow.mapping import scene_water
from aquaflow.sources import open_recording
from aquaflow.types import Frame
from aquaflow.water.estimation import WaterEstimate
from tests.device.whole_dives import FEW_STEPS, write_dimmed_dive
from tests.live.live_scenes import VEHICLE, ToldFeed, caught_up
from tests.render.lost_device import lose_after
from tests.render.render_scenes import needs_adapter, needs_compiler

pytestmark = [needs_adapter, needs_compiler, pytest.mark.ci]

STEPS = merge(FEW_STEPS, {"optimiser": {"refine_steps": 30, "prune_every": 20}})

CUT = 7
"""Frames of the live dive before it is cut off."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dimmed_dive(tmp_path_factory.mktemp("dimmed"))


def metrics_of(recording: Path, renderer: str, folder: Path) -> dict[str, Any]:
    settings = {"threads": 1, "mapping": merge(STEPS, {"renderer": renderer})}
    source = open_recording(recording)
    return map_recording(source, "small", folder, Config.model_validate(settings)).metrics


class SameFits:
    """Fits of the water that a second dive gets from the first: one to eleven pictures leaves so
    much open that the last bits of ranges move the map by half a dB (notes/2026-11-gpu.md#fits)."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._made: list[WaterEstimate | None] = []
        self._again: Iterator[WaterEstimate | None] | None = None
        self._estimating = scene_water.estimating
        monkeypatch.setattr(scene_water, "estimating", self)

    def __call__(self, *args: Any) -> Generator[None, None, WaterEstimate | None]:
        found = yield from self._estimating(*args)
        if self._again is not None:
            return next(self._again)
        self._made.append(found)
        return found

    def repeat(self) -> None:
        self._again = iter(self._made)

    @property
    def are_all_repeated(self) -> bool:
        return self._again is not None and next(self._again, self) is self and bool(self._made)


def test_a_dive_on_wgpu_is_that_of_the_processor(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fits = SameFits(monkeypatch)
    wanted = metrics_of(recording, "cpu", tmp_path / "cpu")
    fits.repeat()
    found = metrics_of(recording, "wgpu", tmp_path / "wgpu")
    assert fits.are_all_repeated
    assert found["renderer"].startswith("wgpu (")
    assert found["psnr"] == pytest.approx(wanted["psnr"], abs=0.05)
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


def test_a_live_dive_on_wgpu_is_gone_on_with_after_a_cut_and_outlives_its_gpu(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = [each for each in open_recording(recording).frames() if isinstance(each, Frame)]
    with live_dive(tmp_path / "dive") as dive:
        for frame in frames[:CUT]:
            dive.parts.loop.take(frame)
        caught_up(dive)
        assert dive.parts.maps.renderer.name == "wgpu"
        mapped = len(dive.parts.maps.mappers[0].gaussians)
        dive.parts.checkpointer.take()
        caught_up(dive)
        assert dive.parts.checkpointer.taken == 1
    with live_dive(tmp_path / "dive") as back:
        assert len(back.parts.maps.mappers[0].gaussians) == mapped > 100
        count = lose_after(monkeypatch, 20, "submit")
        for frame in frames[CUT:]:
            back.parts.loop.take(frame)
        caught_up(back)
        metrics = back.parts.run.finish([]).metrics
    assert count() == 21
    assert metrics["renderer"].startswith("cpu (")
    assert metrics["tracked"] == metrics["frames"] == len(frames)
    assert metrics["psnr"] > 15.0
    assert not metrics["failures"]


@contextmanager
def live_dive(folder: Path) -> Iterator[LiveDive]:
    """A live dive on wgpu in ``folder``, the one that was cut off there if there is one."""
    settings = merge(VEHICLE.model_dump(mode="json"), {"mapping": {"renderer": "wgpu"}})
    vehicle = VehicleConfig.model_validate(settings)
    with closing(LiveDive("live", resume_folder(folder, new=False), ToldFeed(), vehicle)) as dive:
        yield dive
