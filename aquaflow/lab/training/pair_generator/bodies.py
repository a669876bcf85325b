"""What moves on its own between the two views: fish, and an arm of the vehicle or of its diver.

Its pixels have no true match: they are marked as not valid in both views.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.render import median_depth
from aquaflow.lab.training.pairs import Pair, ViewBatch

FISH = 3
"""In a pair, at most."""
FISH_LENGTH = (0.06, 0.25)
"""Half the length of a fish's body, as a share of the picture's width."""
FISH_SWIMS = 0.25
"""Deviation of the way between the two pictures, as a share of the picture's width."""
ARM_WIDTH = (0.05, 0.14)
"""Half the width of an arm, as a share of the picture's width."""
ARM_SWAYS = 0.06
"""Deviation of the way of its hand between the two pictures, as a share of the picture's width."""
NEARER = (0.25, 0.8)
"""Of the scene's median depth: where they are."""
SKIN_TEXELS = 32
"""Along a side of the pattern that a body wears in both pictures."""


def with_bodies(draw: Draw, pair: Pair) -> Pair:
    """The pair with up to FISH fish or an arm in front of it; before water."""
    batch = len(pair.a.K)
    depth = median_depth(pair.a) * draw.uniform(batch, low=NEARER[0], high=NEARER[1])
    skin = draw.uniform(batch, 3, SKIN_TEXELS, SKIN_TEXELS) * draw.uniform(batch, 1, 1, 1, high=0.5)
    skin = skin + draw.uniform(batch, 3, 1, 1, high=0.7)
    has_arm = draw.chance(0.4, batch, 1, 1)
    fish, arm = _fish(draw, pair.a), _arm(draw, pair.a)
    views = []
    for view, swims, sways in zip((pair.a, pair.b), fish, arm, strict=True):
        place = torch.where(has_arm[..., None], sways[0], swims[0])
        inside = torch.where(has_arm, sways[1], swims[1])
        views.append(_cover(view, place, inside, skin, depth))
    return Pair(*views)


def _cover(
    view: ViewBatch,
    place: Tensor,  # [B, H, W, 2] in the body's frame, in [-1, 1] on it
    inside: Tensor,  # [B, H, W] bool
    skin: Tensor,  # [B, 3, n, n]
    depth: Tensor,  # [B] m
) -> ViewBatch:
    pattern = F.grid_sample(skin, place, padding_mode="reflection", align_corners=False)
    # Backs are dark and bellies light on fish; a round arm is lit from above.
    shade = 0.75 - 0.35 * place[..., 1].clamp(-1.0, 1.0)
    image = torch.where(inside[:, None], pattern * shade[:, None], view.image)
    distance = torch.where(inside, depth[:, None, None], view.depth)
    return replace(view, image=image, depth=distance, valid=view.valid & ~inside)


Shapes = list[tuple[Tensor, Tensor]]
"""For both views: [B, H, W, 2] places in the body's frame, [B, H, W] bool: on it."""


def _fish(draw: Draw, view: ViewBatch) -> Shapes:
    batch, (height, width) = len(view.K), view.depth.shape[-2:]
    size = torch.tensor([width, height], device=draw.device)
    heading = draw.uniform(batch, FISH, high=2.0 * math.pi)
    centre = draw.uniform(batch, FISH, 2) * size
    long = draw.log_uniform(batch, FISH, low=FISH_LENGTH[0], high=FISH_LENGTH[1]) * width
    slim = draw.uniform(batch, FISH, low=0.25, high=0.5)
    there = draw.uniform(batch, FISH) < draw.uniform(batch, 1, low=0.34)
    there[:, 0] = True
    shapes = []
    for _ in "ab":
        place = torch.zeros(batch, height, width, 2, device=draw.device)
        inside = torch.zeros(batch, height, width, dtype=torch.bool, device=draw.device)
        for number in range(FISH):
            own = (
                _turn(view, centre[:, number], heading[:, number])
                / long[:, number, None, None, None]
            )
            x, y = own[..., 0], own[..., 1] / slim[:, number, None, None]
            tail = (x < -0.8) & (x > -1.5) & (own[..., 1].abs() < 0.5 * (-0.7 - x))
            on = ((x * x + y * y < 1.0) | tail) & there[:, number, None, None]
            place = torch.where(on[..., None], torch.stack([x, y], -1), place)
            inside = inside | on
        shapes.append((place, inside))
        centre = centre + draw.normal(batch, FISH, 2, sigma=FISH_SWIMS) * width
        heading = heading + draw.normal(batch, FISH, sigma=0.4)
    return shapes


def _arm(draw: Draw, view: ViewBatch) -> Shapes:
    """From the lower part of the picture's border inwards, nearly at rest in the picture."""
    batch, (height, width) = len(view.K), view.depth.shape[-2:]
    size = torch.tensor([width, height], device=draw.device)
    shoulder = torch.stack([draw.uniform(batch, low=-0.1, high=1.1), torch.full((batch,), 1.1)], -1)
    shoulder = shoulder.to(draw.device) * size
    hand = draw.uniform(batch, 2, low=0.25, high=0.75) * size
    half = draw.uniform(batch, low=ARM_WIDTH[0], high=ARM_WIDTH[1]) * width
    shapes = []
    for _ in "ab":
        along = hand - shoulder
        length = along.norm(dim=-1).clamp_min(1.0)
        own = _turn(view, shoulder, torch.atan2(along[:, 1], along[:, 0]))
        x = own[..., 0] / length[:, None, None]
        y = own[..., 1] / half[:, None, None]
        beyond = (own[..., 0] - length[:, None, None]).clamp_min(0.0) / half[:, None, None]
        inside = (x > 0.0) & (y.square() + beyond.square() < 1.0)
        shapes.append((torch.stack([2.0 * x - 1.0, y], -1), inside))
        hand = hand + draw.normal(batch, 2, sigma=ARM_SWAYS) * width
    return shapes


def _turn(
    view: ViewBatch,
    centre: Tensor,  # [B, 2] px
    angle: Tensor,  # [B] radians, of the x axis
) -> Tensor:
    """[B, H, W, 2] px of each pixel in a frame at ``centre``."""
    height, width = view.depth.shape[-2:]
    v, u = torch.meshgrid(
        torch.arange(height, device=centre.device) + 0.5,
        torch.arange(width, device=centre.device) + 0.5,
        indexing="ij",
    )
    x, y = (p[None] - c[:, None, None] for p, c in zip((u, v), centre.unbind(-1), strict=True))
    cos, sin = angle.cos()[:, None, None], angle.sin()[:, None, None]
    return torch.stack([cos * x + sin * y, cos * y - sin * x], -1)
