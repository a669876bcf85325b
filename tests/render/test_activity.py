"""The activity mask: inactive tiles stay black and take no gradient, active ones do not notice."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError
from aquaflow.render.contract import active_pixels, tile_grid, touches_active
from aquaflow.render.cpu import CpuRenderer
from aquaflow.render.limits import TILE_PX
from aquaflow.render.native import build as native
from tests.render.render_scenes import (
    HEIGHT,
    NAMES,
    RENDERERS,
    WIDTH,
    Scene,
    draw_and_differentiate,
    make,
    needs_compiler,
    random_scene,
    reference,
    relative_error,
)

GRID = tile_grid(WIDTH, HEIGHT)
CHECKERBOARD = torch.arange(GRID[0])[:, None].add(torch.arange(GRID[1])) % 2 == 0
LEFT = (torch.arange(GRID[1]) < 2).expand(GRID).contiguous()
LONE = torch.zeros(GRID, dtype=torch.bool)
LONE[1, 2] = True
ALL = [*RENDERERS, "reference"]
MASKS = {"checkerboard": CHECKERBOARD, "left half": LEFT, "one tile": LONE}


def dtype_of(kind: str) -> torch.dtype:
    return torch.float64 if kind == "reference" else torch.float32


def small_scene(seed: int = 0) -> Scene:
    """Footprints a few pixels wide, so that some reach one tile only."""
    return random_scene(seed, n=150, sigma_m=0.02)


@needs_compiler
@pytest.mark.parametrize("isa", native.supported_isas())
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("mask", MASKS)
def test_kernels_draw_active_tiles_to_the_same_bits(isa: str, threads: int, mask: str) -> None:
    scene, pixels = random_scene(10, n=800), active_pixels(MASKS[mask], WIDTH, HEIGHT)
    whole, _ = draw_and_differentiate(CpuRenderer(threads, isa), scene)
    part, _ = draw_and_differentiate(CpuRenderer(threads, isa), scene, active=MASKS[mask])
    assert torch.equal(part.image, whole.image * pixels[..., None])
    assert torch.equal(part.alpha, whole.alpha * pixels)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("mask", MASKS)
def test_gradients_are_those_of_a_loss_on_active_tiles_only(kind: str, mask: str) -> None:
    scene, pixels = small_scene(), active_pixels(MASKS[mask], WIDTH, HEIGHT)
    renderer, dtype = make(kind), dtype_of(kind)
    whole, wanted = draw_and_differentiate(renderer, scene, dtype, seen=pixels)
    part, gradients = draw_and_differentiate(renderer, scene, dtype, active=MASKS[mask])
    assert torch.allclose(part.image, whole.image * pixels[..., None], atol=1e-6)
    for key, gradient, expected in zip(NAMES, gradients, wanted, strict=True):
        assert relative_error(gradient, expected) < 1e-5, key


@pytest.mark.parametrize("kind", RENDERERS)
@pytest.mark.parametrize("mask", MASKS)
def test_masked_drawing_agrees_with_the_masked_reference(kind: str, mask: str) -> None:
    scene = small_scene(1)
    oracle = make("reference")
    wanted, wanted_gradients = draw_and_differentiate(
        oracle, scene, torch.float64, active=MASKS[mask]
    )
    got, gradients = draw_and_differentiate(make(kind), scene, active=MASKS[mask])
    assert (got.image - wanted.image).abs().max() < 3e-5
    assert (got.alpha - wanted.alpha).abs().max() < 3e-5
    assert torch.equal(got.visible, wanted.visible)
    for key, gradient, expected in zip(NAMES, gradients, wanted_gradients, strict=True):
        assert relative_error(gradient, expected) < 5e-5, key


@pytest.mark.parametrize("kind", ALL)
def test_a_gaussian_that_reaches_no_active_tile_is_not_visible_and_takes_no_gradient(
    kind: str,
) -> None:
    scene = small_scene()
    renderer, dtype = make(kind), dtype_of(kind)
    whole, _ = reference(scene)
    part, gradients = draw_and_differentiate(renderer, scene, dtype, active=LONE)
    dropped = whole.visible & ~part.visible
    assert dropped.any()
    assert part.visible.any()
    assert not part.radius_px[~part.visible].any()
    assert not any(gradient[dropped].any() for gradient in gradients[:5])


@pytest.mark.parametrize("kind", ALL)
def test_a_picture_without_active_tiles_is_black_and_takes_no_gradient(kind: str) -> None:
    nothing = torch.zeros(GRID, dtype=torch.bool)
    out, gradients = draw_and_differentiate(
        make(kind), random_scene(0), dtype_of(kind), active=nothing
    )
    assert out.image.shape == (HEIGHT, WIDTH, 4)
    assert not out.image.any()
    assert not out.alpha.any()
    assert not out.visible.any()
    assert not any(gradient.any() for gradient in gradients)


@needs_compiler
def test_a_mask_does_not_outlive_its_picture() -> None:
    renderer, scene = CpuRenderer(1), random_scene(0)
    whole, _ = draw_and_differentiate(renderer, scene)
    draw_and_differentiate(renderer, scene, active=LONE)
    again, _ = draw_and_differentiate(renderer, scene)
    assert torch.equal(again.image, whole.image)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize(
    "active", [torch.ones(GRID[::-1], dtype=torch.bool), torch.ones(GRID), CHECKERBOARD[0]]
)
def test_a_mask_that_does_not_fit_the_picture_is_named(kind: str, active: Tensor) -> None:
    with pytest.raises(AquaFlowError, match="active"):
        make(kind)(*random_scene(0).leaves(), WIDTH, HEIGHT, active)


def test_pixels_take_the_activity_of_their_tile() -> None:
    pixels = active_pixels(LONE, WIDTH, HEIGHT)
    assert pixels.shape == (HEIGHT, WIDTH)
    assert pixels.sum() == TILE_PX * TILE_PX
    assert pixels[TILE_PX : 2 * TILE_PX, 2 * TILE_PX : 3 * TILE_PX].all()


def test_the_summed_area_table_finds_what_looking_at_every_tile_finds() -> None:
    rng = torch.Generator().manual_seed(3)
    active = torch.rand(GRID, generator=rng) < 0.2
    low = torch.rand(300, 2, generator=rng) * torch.tensor([WIDTH, HEIGHT])
    high = low + 20 * torch.rand(300, 2, generator=rng)
    got = touches_active(low, high, active, WIDTH, HEIGHT)
    for (x0, y0), (x1, y1), touched in zip(low.tolist(), high.tolist(), got.tolist(), strict=True):
        rows = range(GRID[0])
        wanted = any(
            bool(active[row, column])
            for row in rows
            for column in range(GRID[1])
            if int((x0 - 0.5) // TILE_PX) <= column <= int((x1 - 0.5) // TILE_PX)
            and int((y0 - 0.5) // TILE_PX) <= row <= int((y1 - 0.5) // TILE_PX)
        )
        assert touched == wanted
