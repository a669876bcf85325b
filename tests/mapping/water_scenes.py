"""Maps of a floor in water that is not known yet, and the pictures that were taken of it."""

from __future__ import annotations

import numpy as np
import torch

from aquaflow.config import MediumConfig
from aquaflow.mapping.scene import Scene
from aquaflow.render.views import View
from tests.mapping.mapping_scenes import filmed, floor, gaussians_at, pose, renderer, view_of, water

NEAR_AND_FAR = [pose((0.02 * i, 0.0, -0.35 * i)) for i in range(5)]


def scene(enabled: bool = True, exposure: bool = True) -> Scene:
    config = MediumConfig(enabled=enabled, exposure=exposure)
    return Scene(config, renderer(), torch.Generator().manual_seed(0))


def random() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def submerged() -> tuple[Scene, list[View]]:
    """A map of a floor coloured as if there were little water, and pictures through more.

    Every picture is of one range, so that light and water could not be told apart: it is even.
    """
    floating = scene(exposure=False)
    floor_map = floor(columns=18, rows=14)
    views = filmed(floor_map, NEAR_AND_FAR, water(beta=0.3, b=0.3))
    murk, z = water(beta=0.3, b=0.3), floor_map.means.norm(dim=-1)
    weak = floating.water(views[0])
    assert weak is not None
    seen = floor_map.colours * murk.transmission(z) + murk.backscatter(z)
    coloured, _ = weak.restore(seen.detach(), z)
    floating.gaussians = gaussians_at(floor_map.means, coloured.detach(), 0.09)
    return floating, views


def in_clear_water(dimmed_from: int | None = None) -> tuple[Scene, list[View]]:
    """A map of a floor, and pictures through no water; the lamps may go down."""
    dry = scene()
    floor_map = floor(columns=18, rows=14)
    views = filmed(floor_map, NEAR_AND_FAR)
    if dimmed_from is not None:
        views = [
            view_of((v.image * (1.0 if i < dimmed_from else 0.6)).astype(np.uint8), v.T_wc, i)
            for i, v in enumerate(views)
        ]
    dry.gaussians = gaussians_at(floor_map.means, floor_map.colours, 0.09)
    return dry, views
