"""Active tiles of a view in a step: neither on the vehicle nor explained already.

A tile whose error is no more than the camera's own noise can teach the map nothing; it is neither
drawn nor differentiated until the next full drawing of its view, which may show that the map around
it has changed.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from aquaflow.config import OptimiserConfig
from aquaflow.render.contract import TILE_PX
from aquaflow.render.views import View


def is_full_look(view: View, config: OptimiserConfig) -> bool:
    """True if the view's next step draws all of it."""
    return view.looks % config.full_look_every == 0


def tiles_to_draw(view: View, config: OptimiserConfig) -> Tensor | None:
    """[rows, columns] bool of the view's tiles for its next step; None: all of them."""
    if config.noise_floor == 0.0:
        return None
    explained = None if is_full_look(view, config) else view.explained
    if view.mask is None:
        return None if explained is None else ~explained
    scene = F.max_pool2d(view.scene_mask()[None].float(), TILE_PX, ceil_mode=True)[0] > 0.0
    return scene if explained is None else scene & ~explained


def is_nothing_to_draw(
    view: View,
    active: Tensor | None,  # [rows, columns] bool, from tiles_to_draw
    config: OptimiserConfig,
) -> bool:
    """True if no tile is active; between two full looks the device is asked only once."""
    if active is None:
        return False
    if is_full_look(view, config):
        return not bool(active.any())
    if view.all_explained is None:
        view.all_explained = not bool(active.any())
    return view.all_explained


@torch.no_grad()
def record_explained(
    view: View,
    image: Tensor,  # [H, W, 3] the map from this view
    config: OptimiserConfig,
) -> None:
    """Count the step; after a full drawing record which tiles are explained."""
    if is_full_look(view, config):
        error = (image - view.target()).abs().mean(dim=-1)
        if view.mask is not None:
            error *= view.scene_mask()
        tiles = F.avg_pool2d(error[None], TILE_PX, ceil_mode=True)[0]
        view.explained, view.all_explained = tiles < config.noise_floor, None
    view.looks += 1
