"""Our calls of gsplat fit the installed package, and what we make of its results is right.

Its kernels need a GPU. Everything else is tested here: the signatures are those of the package,
which is installed with ``--no-deps``; projection and tiles are its own torch implementation, on the
CPU; only the last step, the blending, is ours in its place.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from aquaflow.render import gsplat as ours
from aquaflow.render.contract import CPU, Rendering, active_pixels, tile_grid
from aquaflow.render.example_scene import SMALL, height_field
from aquaflow.render.limits import MIN_ALPHA, TILE_PX
from aquaflow.render.reference import alpha_at, blend_weights, differences, too_far
from tests.render.render_scenes import (
    HEIGHT,
    NAMES,
    WIDTH,
    draw_and_differentiate,
    random_scene,
    reference,
    relative_error,
)

gsplat = pytest.importorskip(
    "gsplat", reason="gsplat is not installed (pip install --no-deps gsplat): CI has it"
)

STEPS = ("fully_fused_projection", "isect_tiles", "isect_offset_encode", "rasterize_to_pixels")
"""What is called of the package."""


class Recorded(ModuleType):
    """The package, whose steps run on the CPU and are noted with how they were called."""

    def __init__(self) -> None:
        super().__init__("gsplat")
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []
        self.tiles_in_order = 0
        for name in STEPS:
            setattr(self, name, self._noting(name, getattr(self, f"_{name}")))

    def _noting(self, name: str, step: Callable[..., Any]) -> Callable[..., Any]:
        real = inspect.signature(getattr(gsplat, name))

        def noted(*args: Any, **kwargs: Any) -> Any:
            bound = real.bind(*args, **kwargs)
            self.calls.append((name, args, kwargs))
            return step(**bound.arguments)

        return noted

    @staticmethod
    def _fully_fused_projection(**given: Any) -> tuple[Tensor, ...]:
        from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

        opacities, quats, scales = (given.pop(name) for name in ("opacities", "quats", "scales"))
        del given["packed"], given["covars"]
        covars, _ = _quat_scale_to_covar_preci(quats, scales, True, False, triu=False)
        found: tuple[Tensor, ...] = _fully_fused_projection(covars=covars, **given)
        radii, *others = found
        seen = (opacities > MIN_ALPHA)[None, :, None]
        return (radii * seen, *others)

    @staticmethod
    def _isect_tiles(**given: Any) -> tuple[Tensor, ...]:
        from gsplat.cuda._torch_impl import _isect_tiles

        del given["packed"]
        found: tuple[Tensor, ...] = _isect_tiles(**given)
        return found

    @staticmethod
    def _isect_offset_encode(**given: Any) -> Tensor:
        from gsplat.cuda._torch_impl import _isect_offset_encode

        found: Tensor = _isect_offset_encode(*given.values())
        return found

    def _rasterize_to_pixels(self, **given: Any) -> tuple[Tensor, Tensor]:
        """Every Gaussian at every pixel in the order of the tiles' lists; other tiles hold what
        the memory held, as in gsplat's kernel."""
        width, height = given["image_width"], given["image_height"]
        assert given["tile_size"] == TILE_PX
        assert given["isect_offsets"].shape == (1, *tile_grid(width, height))
        order = given["flatten_ids"]
        self.tiles_in_order = len(order)
        x, y = torch.arange(width) + 0.5, torch.arange(height) + 0.5
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), 2).view(-1, 2)
        listed = torch.unique(order)
        offset = pixels[None] - given["means2d"][0, listed, None]
        alpha = alpha_at(offset, given["conics"][0, listed], given["opacities"][0, listed])
        # Front to back: the order in which the lists have them in any one tile is by depth.
        depth = self.calls[1][1][2][0, listed]
        front = torch.argsort(depth, stable=True)
        weights = blend_weights(alpha[front], 0)
        image = (weights.T @ given["colors"][0, listed][front]).view(height, width, -1)
        opaque = weights.sum(0).view(height, width, 1)
        if given["masks"] is not None:
            assert given["masks"].shape == given["isect_offsets"].shape
            drawn = active_pixels(given["masks"][0], width, height)[..., None]
            image = torch.where(drawn, image, 0.0)
            opaque = torch.where(drawn, opaque, float("nan"))
        return image[None], opaque[None]


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> Recorded:
    package = Recorded()
    monkeypatch.setitem(__import__("sys").modules, "gsplat", package)
    return package


def renderer() -> ours.GsplatRenderer:
    """One that draws on the CPU."""
    made = object.__new__(ours.GsplatRenderer)
    made.device = CPU
    return made


def test_every_call_fits_the_signature_of_the_installed_package(recorded: Recorded) -> None:
    draw_and_differentiate(renderer(), random_scene())
    assert [name for name, _, _ in recorded.calls] == list(STEPS)


def test_the_package_returns_as_many_results_as_are_taken() -> None:
    projection = inspect.signature(gsplat.fully_fused_projection).return_annotation
    assert len(projection.__args__) == 5
    tiles = inspect.signature(gsplat.isect_tiles).return_annotation
    assert len(tiles.__args__) == 3


def test_picture_alpha_and_gradients_are_those_of_the_reference(recorded: Recorded) -> None:
    scene = random_scene(0)
    wanted, wanted_gradients = reference(scene)
    got, gradients = draw_and_differentiate(renderer(), scene)
    assert (got.alpha - wanted.alpha).abs().max() < 1 / 255
    assert (got.image - wanted.image).abs().max() < 4 / 255  # ranges reach 4 m
    for key, gradient, expected in zip(NAMES, gradients, wanted_gradients, strict=True):
        assert relative_error(gradient, expected) < 0.05, key


def test_the_doctors_scene_is_drawn_as_by_the_reference(recorded: Recorded) -> None:
    assert too_far(differences(renderer(), height_field(SMALL))) is None
    assert recorded.calls


def drawn_with(active: Tensor | None) -> tuple[Rendering, list[Tensor]]:
    scene = random_scene(0)
    rows, columns = tile_grid(WIDTH, HEIGHT)
    pixels = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    pixels[:TILE_PX, :TILE_PX] = True
    assert (rows, columns) == (3, 4)
    return draw_and_differentiate(renderer(), scene, active=active, seen=pixels)


def test_tiles_that_are_not_active_are_neither_listed_nor_drawn_nor_differentiated(
    recorded: Recorded,
) -> None:
    whole, whole_gradients = drawn_with(None)
    listed = recorded.tiles_in_order
    active = torch.zeros(tile_grid(WIDTH, HEIGHT), dtype=torch.bool)
    active[0, 0] = True
    recorded.calls.clear()
    part, gradients = drawn_with(active)
    assert recorded.tiles_in_order < listed
    drawn = active_pixels(active, WIDTH, HEIGHT)
    torch.testing.assert_close(part.alpha[drawn], whole.alpha[drawn])
    assert not part.alpha[~drawn].any()
    assert not part.image[~drawn].any()
    assert int(part.visible.sum()) < int(whole.visible.sum())
    for key, gradient, expected in zip(NAMES, gradients, whole_gradients, strict=True):
        assert torch.isfinite(gradient).all(), key
        assert relative_error(gradient, expected) < 1e-4, key


def test_what_is_not_sound_is_not_given_to_the_package(recorded: Recorded) -> None:
    scene = random_scene(0)
    scene.means[3] = torch.nan
    scene.scales[4] = 0.0
    got, _ = draw_and_differentiate(renderer(), scene)
    means = recorded.calls[0][1][0]
    assert len(means) == len(scene.means) - 2
    assert not got.visible[3]
    assert not got.visible[4]


def test_an_empty_map_draws_a_black_picture(recorded: Recorded) -> None:
    scene = random_scene(0)
    scene.opacities.zero_()
    got = renderer()(*scene.leaves(), WIDTH, HEIGHT)
    assert not got.image.any()
    assert recorded.calls == []
