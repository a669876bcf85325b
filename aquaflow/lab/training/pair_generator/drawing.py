"""Pairs of the pool as a camera would take them: fresh windows, water and exposure each time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.conditions import CALM, Conditions
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.render import median_depth
from aquaflow.lab.training.pair_generator.scene import rotation
from aquaflow.lab.training.pair_generator.sensor import take_picture
from aquaflow.lab.training.pair_generator.water import random_water, turbidity
from aquaflow.lab.training.pairs import Pair, ViewBatch, project, seen_from


@dataclass(frozen=True)
class WindowVariation:
    """How the windows of a pair differ from the pictures that were rendered."""

    width: int = 128
    height: int = 96
    zoom: float = 1.3
    """Largest factor of either view's focal length, and the inverse of the smallest."""
    tilt: float = 0.1
    """Radians, deviation of the second view about the axes of the picture."""
    roll: float = 0.6
    """Radians, most that the second view rolls; evenly spread."""
    jitter: float = 0.2
    """Of the window's sides: how far from its middle the first view's middle is seen."""
    same_place: float = 0.3
    """Share of pairs whose views differ by a homography only."""
    recoloured: float = 0.3
    """Share of batches whose channels change places: colour is what water takes first."""


def through_water(draw: Draw, pair: Pair, conditions: Conditions = CALM) -> Pair:
    """The pair with images as taken through one water, each with its own exposure.

    What covers the scene is not valid, and has no depth when the pair is done.
    """
    bare = pair
    pair = conditions.before_water(draw, pair)
    water = random_water(draw, median_depth(pair.a))
    water = water.denser(turbidity(draw, conditions.turbid, len(pair.a.K)))
    a, b = (
        replace(view, image=take_picture(draw, conditions.before_lens(draw, water.through(view))))
        for view in (pair.a, pair.b)
    )
    pair = conditions.after_sensor(draw, Pair(a, b))
    return Pair(_uncover(pair.a, bare.a), _uncover(pair.b, bare.b))


def training_pair(
    draw: Draw, clear: Pair, looks: WindowVariation, conditions: Conditions = CALM
) -> Pair:
    """One use of pairs without water: other windows, another water, another camera."""
    if bool(draw.chance(0.5)):
        clear = clear.swap()
    same = draw.chance(looks.same_place, len(clear.a.K))
    clear = Pair(clear.a, _choose(same, clear.a, clear.b))
    pair = through_water(draw, windows(draw, clear, looks), conditions)
    if bool(draw.chance(looks.recoloured)):
        order = torch.randperm(3, generator=draw.generator, device=draw.device)
        a, b = (replace(view, image=view.image[:, order]) for view in (pair.a, pair.b))
        pair = Pair(a, b)
    return pair


def _uncover(view: ViewBatch, bare: ViewBatch) -> ViewBatch:
    """``view`` without the depth of what covers ``bare``."""
    return replace(view, depth=torch.where(bare.valid & ~view.valid, 0.0, view.depth))


def windows(draw: Draw, pair: Pair, looks: WindowVariation) -> Pair:
    """Both views turned and zoomed; the second one looks at about what the first one sees."""
    height, width = pair.a.depth.shape[-2:]
    batch = len(pair.a.K)
    size = torch.tensor([width, height], device=draw.device)
    middle = size * draw.uniform(batch, 2, low=0.3, high=0.7)
    seen = _where_seen(pair, middle.floor() + 0.5, size / 2.0)
    a = _window(draw, pair.a, middle, looks, 0.1 * looks.roll, 0.0, 0.0)
    b = _window(draw, pair.b, seen, looks, looks.roll, looks.tilt, looks.jitter)
    return Pair(a, b)


def _where_seen(
    pair: Pair,
    pixels: Tensor,  # [B, 2] px in a
    otherwise: Tensor,  # [2] px
) -> Tensor:
    """[B, 2] px in b, hidden or not; ``otherwise`` where a's depth is unknown or b looks away."""
    column, row = pixels.long().unbind(-1)
    depth = pair.a.depth[torch.arange(len(pixels), device=pixels.device), row, column]
    ray = torch.linalg.solve(pair.a.K, F.pad(pixels, (0, 1), value=1.0)[..., None])[..., 0]
    point = (ray * depth[:, None])[:, None, None]
    there, inside = project(seen_from(pair.b.T_wc, point, pair.a.T_wc), pair.b)
    known = inside[:, 0, 0] & (depth > 0)
    return torch.where(known[:, None], there[:, 0, 0], otherwise)


def _window(
    draw: Draw,
    view: ViewBatch,
    middle: Tensor,  # [B, 2] px that the window is centred on
    looks: WindowVariation,
    roll: float,
    tilt: float,
    jitter: float,
) -> ViewBatch:
    batch = len(view.K)
    turn = draw.normal(batch, 3, sigma=tilt)
    turn[:, 2] = draw.uniform(batch, low=-roll, high=roll)
    R = rotation(turn)
    K = view.K.clone()
    K[:, :2, :2] = K[:, :2, :2] * draw.log_uniform(
        batch, 1, 1, low=1.0 / looks.zoom, high=looks.zoom
    )
    ray = torch.linalg.solve(view.K, F.pad(middle, (0, 1), value=1.0)[..., None])
    at = (K[:, :2, :2] @ (R.mT @ ray)[:, :2])[..., 0] / (R.mT @ ray)[:, 2]
    size = torch.tensor([looks.width, looks.height], device=draw.device)
    K[:, :2, 2] = size * (0.5 + draw.uniform(batch, 2, low=-jitter, high=jitter)) - at
    return turned_view(view, K, R, looks.width, looks.height)


def _choose(
    first: Tensor,  # [B] bool
    a: ViewBatch,
    b: ViewBatch,
) -> ViewBatch:
    """``a`` where ``first`` holds, ``b`` elsewhere."""

    def pick(x: Tensor, y: Tensor) -> Tensor:
        return torch.where(first.view(-1, *[1] * (x.dim() - 1)), x, y)

    return ViewBatch(
        pick(a.image, b.image),
        pick(a.depth, b.depth),
        pick(a.K, b.K),
        pick(a.T_wc, b.T_wc),
        pick(a.valid, b.valid),
    )


# --------------------------------------------------------------------------------------------------
# A second look at a picture: turned, zoomed and shifted about the same centre of projection.
#
# What a turned camera sees follows from the picture exactly, depth included, so that one rendered
# view gives many, and a view with itself gives pairs of a homography with exact matches.

SMOOTH = 1.1
"""Ratio of neighbouring depths above which a depth between them is that of neither."""


def turned_view(
    view: ViewBatch,
    K: Tensor,  # [B, 3, 3] of the new picture
    R: Tensor,  # [B, 3, 3] new camera to old
    width: int,
    height: int,
) -> ViewBatch:
    """The view through another camera at the same place; beyond the picture it is mirrored."""
    T_wc = view.T_wc.clone()
    T_wc[:, :3, :3] = view.T_wc[:, :3, :3] @ R
    empty = torch.zeros(len(K), height, width, device=K.device)
    rays = ViewBatch(view.image, empty, K, T_wc, empty > 0).rays(height, width) @ R[:, None].mT
    old = rays[..., :2] / rays[..., 2:].clamp_min(1e-3)
    focal = torch.stack([view.K[:, 0, 0], view.K[:, 1, 1]], -1)[:, None, None]
    pixels = old * focal + view.K[:, None, None, :2, 2]
    size = torch.tensor(view.depth.shape[:-3:-1], device=K.device)
    grid = pixels / size * 2.0 - 1.0
    image = F.grid_sample(view.image, grid, padding_mode="reflection", align_corners=False)
    # Inverse depth is linear in the pixels of a plane.
    inverse = torch.where(view.valid, 1.0 / view.depth.clamp_min(1e-3), 0.0)
    known = torch.stack([inverse, (view.valid & ~_edges(view)).float()], 1)
    inverse, clear = F.grid_sample(known, grid, align_corners=False).unbind(1)
    inside = ((pixels > 0.5) & (pixels < size - 0.5)).all(-1) & (rays[..., 2] > 1e-3)
    depth = 1.0 / (inverse * rays[..., 2]).clamp_min(1e-3)
    # Water is drawn over all of the picture, so the mirrored part has a depth too.
    mirrored = F.grid_sample(
        view.depth[:, None], grid, mode="nearest", padding_mode="reflection", align_corners=False
    )[:, 0]
    valid = inside & (clear > 0.999)
    return ViewBatch(image, torch.where(valid, depth, mirrored), K, T_wc, valid)


def _edges(view: ViewBatch) -> Tensor:
    """[B, H, W] bool: one of the four neighbours differs in depth, or is not known."""
    across = _differ(view.depth[:, :, 1:], view.depth[:, :, :-1])
    down = _differ(view.depth[:, 1:], view.depth[:, :-1])
    across = F.pad(across, (1, 0)) | F.pad(across, (0, 1))
    return across | F.pad(down, (0, 0, 1, 0)) | F.pad(down, (0, 0, 0, 1))


def _differ(
    one: Tensor,  # [B, h, w] m
    other: Tensor,  # [B, h, w] m
) -> Tensor:
    return (one > SMOOTH * other) | (other > SMOOTH * one)
