"""Pairs of the pool as a camera would take them: fresh windows, water and exposure each time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.correspondences import project
from aquaflow.lab.training.pair_generator.conditions import CALM, Conditions
from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.render import median_depth
from aquaflow.lab.training.pair_generator.scene import rotation
from aquaflow.lab.training.pair_generator.second_view import turned_view
from aquaflow.lab.training.pair_generator.sensor import take_picture
from aquaflow.lab.training.pair_generator.water import random_water, turbidity
from aquaflow.lab.training.pairs import Pair, ViewBatch, seen_from


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
