"""The renderer ``wgpu`` where it differs from the others: sorting, room, and a GPU that fails."""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from aquaflow.render import choice, select_renderer
from aquaflow.render import webgpu_device as webgpu
from aquaflow.render.contract import CPU, Rendering
from aquaflow.render.cpu import CpuRenderer
from aquaflow.render.example_scene import Size, height_field
from aquaflow.render.webgpu import WgpuRenderer
from aquaflow.render.webgpu_device import Adapter, missing, shared_device
from aquaflow.render.webgpu_drawing import LEAST_HITS, SORTED, Drawing
from tests.render.lost_device import lose_after
from tests.render.render_scenes import (
    NAMES,
    Scene,
    draw_and_differentiate,
    needs_adapter,
    needs_compiler,
    random_scene,
    reference,
    relative_error,
)

RADEON = Adapter("Radeon", "Vulkan", "IntegratedGPU", "radv")
LLVMPIPE = Adapter("llvmpipe", "Vulkan", "CPU", "Mesa")


def any_scene(seed: int) -> Scene:
    """Gaussians by the hundred, of sizes from less than a pixel to half a picture."""
    rng = torch.Generator().manual_seed(seed)
    n = int(torch.randint(1, 500, (), generator=rng))
    sigma_m = float(10.0 ** (-2.5 + 2.0 * torch.rand((), generator=rng)))
    return random_scene(100 + seed, n=n, channels=3 + seed % 2, sigma_m=sigma_m)


@needs_adapter
@pytest.mark.parametrize("seed", range(20))
def test_pictures_and_gradients_are_the_float64_references(seed: int) -> None:
    scene = any_scene(seed)
    wanted, wanted_gradients = reference(scene)
    got, gradients = draw_and_differentiate(WgpuRenderer(), scene)
    assert (got.image - wanted.image).abs().max() < 1e-4
    assert (got.alpha - wanted.alpha).abs().max() < 1e-4
    for name, gradient, expected in zip(NAMES, gradients, wanted_gradients, strict=True):
        assert relative_error(gradient, expected) < 1e-3, name


@needs_adapter
@needs_compiler
def test_more_gaussians_than_a_workgroup_sorts_and_more_hits_than_there_was_room_for() -> None:
    scene = height_field(Size(3 * SORTED + 5, 100, 70))
    found = draw_scene(WgpuRenderer(), scene)
    wanted = draw_scene(CpuRenderer(1), scene)
    assert (found.image - wanted.image).abs().max() < 1e-3  # the range is up to 5
    drawing = Drawing(shared_device())
    drawing.hits = 64
    renderer = WgpuRenderer()
    renderer._idle.append(drawing)
    again = draw_scene(renderer, scene)
    assert drawing.hits > LEAST_HITS
    assert torch.equal(again.image, found.image)


def draw_scene(renderer: Any, scene: Any) -> Rendering:
    with torch.no_grad():
        drawn: Rendering = scene.drawn_by(renderer, scene.inputs)
    return drawn


@needs_adapter
def test_buffers_of_a_larger_map_serve_a_smaller_one() -> None:
    renderer = WgpuRenderer()
    small, large = random_scene(3, n=40), random_scene(4, n=900)
    first, _ = draw_and_differentiate(renderer, small)
    draw_and_differentiate(renderer, large)
    assert len(renderer._idle) == 1
    again, _ = draw_and_differentiate(renderer, small)
    assert torch.equal(first.image, again.image)


# --- a GPU that fails ---------------------------------------------------------------------------


@needs_adapter
@needs_compiler
@pytest.mark.parametrize(
    ("call", "after"), [("submit", 0), ("read", 0), ("submit", 1), ("read", 1)]
)
def test_a_device_that_is_lost_leaves_its_drawing_to_the_processor(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, call: str, after: int
) -> None:
    scene, renderer = random_scene(0), WgpuRenderer()
    wanted, wanted_gradients = draw_and_differentiate(CpuRenderer(1), scene)
    lose_after(monkeypatch, after, call)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            got, gradients = draw_and_differentiate(renderer, scene)
            assert (got.image - wanted.image).abs().max() < 1e-4
            for gradient, expected in zip(gradients, wanted_gradients, strict=True):
                assert relative_error(gradient, expected) < 1e-4
    assert renderer.name == "cpu"
    assert renderer.failed is not None
    assert renderer.failed.endswith("failed (Parent device is lost)")
    assert len(caplog.records) == 1
    assert "the processor draws from here on" in caplog.text


@needs_adapter
@needs_compiler
def test_a_map_that_the_adapter_has_no_room_for_is_drawn_by_the_processor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    renderer = WgpuRenderer()
    monkeypatch.setattr(renderer._device, "most_bytes", 1 << 16)
    draw_and_differentiate(renderer, random_scene(0, n=3000))
    assert renderer.failed is not None
    assert "gives buffers of 0 MB at most" in renderer.failed


# --- which adapter, and whether ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("found", "software", "said"),
    [
        ([], True, "finds no adapter; install the GPU's Vulkan driver"),
        ([LLVMPIPE], False, "wgpu finds only llvmpipe (CPU, Vulkan, Mesa), which is slower"),
        ([LLVMPIPE], True, None),
        ([RADEON, LLVMPIPE], False, None),
    ],
)
def test_a_program_that_stands_in_for_a_gpu_counts_only_where_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, found: list[Adapter], software: bool, said: str | None
) -> None:
    monkeypatch.setattr(webgpu, "missing_package", lambda: None)
    monkeypatch.setattr(webgpu, "_has_gpu", lambda: True)
    monkeypatch.setattr(webgpu, "find_adapters", lambda: [(each, None) for each in found])
    reason = missing(software)
    assert reason is None if said is None else said in str(reason)


@pytest.mark.skipif(sys.platform != "linux", reason="/dev is Linux's")
@pytest.mark.parametrize("node", ["dri/renderD128", "nvidiactl", "nvhost-gpu", "nvmap", "dxg"])
def test_drivers_are_only_loaded_where_there_is_a_gpu(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, node: str
) -> None:
    (tmp_path / node).parent.mkdir(exist_ok=True)
    assert not webgpu._has_gpu(tmp_path)
    (tmp_path / node).touch()
    assert webgpu._has_gpu(tmp_path)
    monkeypatch.setattr(webgpu, "missing_package", lambda: None)
    monkeypatch.setattr(webgpu, "_has_gpu", lambda: False)
    monkeypatch.setattr(webgpu, "find_adapters", lambda: pytest.fail("drivers were loaded"))
    assert missing(software=False) == "There is no GPU: /dev has no device of one."


class Slow:
    """The processor's renderer, as slow, as wrong or as broken as is asked for."""

    isa, threads, device = "torch", 1, CPU

    def __init__(self, name: str, gain: float = 1.0, error: str = "") -> None:
        self.name, self._gain, self._error, self._drawn = name, gain, error, CpuRenderer(1)

    def __call__(self, *inputs: Any) -> Rendering:
        if self._error:
            raise RuntimeError(self._error)
        drawn = self._drawn(*inputs)
        return replace(drawn, image=self._gain * drawn.image)


@needs_compiler
@pytest.mark.parametrize(("seconds", "chosen"), [((0.1, 0.3), "gpu"), ((0.3, 0.1), "cpu")])
def test_the_fastest_renderer_is_taken_and_said(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    seconds: tuple[float, float],
    chosen: str,
) -> None:
    times = iter(seconds)
    monkeypatch.setattr(choice, "step_seconds", lambda *_: next(times))
    with caplog.at_level(logging.INFO):
        taken = choice.fastest([lambda: Slow("gpu"), lambda: Slow("cpu")])
    assert taken.name == chosen
    assert "gpu" in caplog.text
    assert "cpu" in caplog.text


@needs_compiler
def test_a_renderer_that_fails_or_draws_wrongly_is_left_out(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(choice, "step_seconds", lambda *_: 0.1)
    makers = [
        lambda: Slow("bright", gain=1.1),
        lambda: Slow("broken", error="device lost"),
        lambda: Slow("cpu"),
    ]
    assert choice.fastest(makers).name == "cpu"
    assert "renderer bright is left out: its picture is" in caplog.text
    assert "a renderer is left out: device lost" in caplog.text


@needs_compiler
def test_a_step_is_timed_on_the_map_that_is_given() -> None:
    assert 0.0 < choice.step_seconds(CpuRenderer(1), height_field(Size(50, 40, 30))) < 60.0


@needs_adapter
def test_auto_does_not_take_a_program_that_stands_in_for_a_gpu() -> None:
    if not shared_device().adapter.is_software:
        pytest.skip("this machine has a GPU")
    assert select_renderer("auto").name != "wgpu"
    assert select_renderer("wgpu").name == "wgpu"
