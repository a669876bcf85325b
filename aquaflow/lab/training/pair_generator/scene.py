"""What is looked at: a sea floor with rocks, loose bodies and pipes, and the light on them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.noise import periodic, spectral, wrap
from aquaflow.lab.training.pair_generator.regular import regular_albedo
from aquaflow.lab.training.pair_generator.texture import Atlas, albedo, atlas

ROCKS = 10
"""Stamps on the floor, at most."""
SOLIDS = 8
"""Bodies that stand or float about, at most."""
FLATTENED = 0.05
"""Factor of the relief, and of the rocks, where the floor is laid or a net is hung."""


@dataclass(frozen=True)
class Detail:
    """Texels along a side of what is periodic, and how much of it repeats itself."""

    terrain: int = 256
    texture: int = 512
    regular: float = 0.0
    """Share of scenes with a tiled floor or a net."""


@dataclass(frozen=True)
class Terrain:
    """A periodic heightfield, z up."""

    field: Tensor
    """[B, 2, n + 1, n + 1] height in metres, and the share of rock in [0, 1]"""
    period: Tensor
    """[B] metres"""

    def height(
        self,
        places: Tensor,  # [B, N, 2] metres
    ) -> Tensor:
        """[B, N] metres."""
        return periodic(self.field[:, :1], places / self.period[:, None, None])[:, 0]

    def rock(
        self,
        places: Tensor,  # [B, N, 2] metres
    ) -> Tensor:
        """[B, N] in [0, 1]."""
        return periodic(self.field[:, 1:], places / self.period[:, None, None])[:, 0]

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """[B] lowest and highest height."""
        height = self.field[:, 0].flatten(1)
        return height.amin(1), height.amax(1)


@dataclass(frozen=True)
class Solids:
    """Ellipsoids (pipes are long ones) and boxes."""

    R: Tensor
    """[B, S, 3, 3] body to world"""
    centre: Tensor
    """[B, S, 3] metres"""
    half: Tensor
    """[B, S, 3] half extents, metres"""
    box: Tensor
    """[B, S] bool: a box, otherwise an ellipsoid"""
    there: Tensor
    """[B, S] bool"""


@dataclass(frozen=True)
class Light:
    """Sun through the waves, sky, and the vehicle's own lamps."""

    sun: Tensor
    """[B, 3] unit vector to the sun"""
    ambient: Tensor
    """[B] share of the sky's light"""
    lamps: Tensor
    """[B] share of the vehicle's light, 0 for none"""
    lamp: Tensor
    """[B, 3] where the lamps are in the camera's frame, metres"""
    caustics: Tensor
    """[B] strength of the moving pattern, 0 for none"""
    pattern: Tensor
    """[B, 1, n + 1, n + 1] periodic, mean about 1/3"""


@dataclass(frozen=True)
class SceneBatch:
    """A batch of scenes."""

    terrain: Terrain
    solids: Solids
    materials: Atlas
    """0: loose floor, 1: rock, 2: bodies"""
    texture_period: Tensor
    """[B] metres"""
    shear: Tensor
    """[B, 2] how the texture shifts with height, so that steep sides have detail"""
    light: Light


def random_scenes(draw: Draw, batch: int, detail: Detail) -> SceneBatch:
    """``batch`` scenes, each unlike the others."""
    terrain, solids = _terrain(draw, batch, detail.terrain), _solids(draw, batch)
    floor, rock, bodies = (albedo(draw, batch, detail.texture) for _ in range(3))
    if detail.regular > 0.0:
        chosen = draw.chance(detail.regular, batch)[:, None, None, None]
        floor = torch.where(chosen, regular_albedo(draw, batch, detail.texture), floor)
        field = torch.where(chosen, FLATTENED * terrain.field, terrain.field)
        terrain = Terrain(field, terrain.period)
    return SceneBatch(
        terrain,
        solids,
        atlas([floor, rock, bodies]),
        draw.log_uniform(batch, low=1.2, high=5.0),
        draw.uniform(batch, 2, low=-1.0, high=1.0),
        _light(draw, batch, detail.terrain),
    )


def _terrain(draw: Draw, batch: int, size: int) -> Terrain:
    smooth = spectral(draw, size, draw.uniform(batch, low=2.5, high=3.8))
    rough = spectral(draw, size, draw.uniform(batch, low=2.4, high=3.4))
    kind = draw.uniform(batch, 1, 1)
    ridges, mounds = -1.3 * smooth.abs(), 1.2 * rough.clamp_min(0.0) + 0.3 * smooth
    height = torch.where(kind < 0.25, ridges, torch.where(kind < 0.5, mounds, smooth))
    height = height * draw.log_uniform(batch, 1, 1, low=0.03, high=0.45)
    rocks = torch.zeros_like(height)
    for _ in range(ROCKS):
        rocks = rocks + _rock(draw, batch, size)
    share = ((rocks > 0.02).float() + (rough > draw.uniform(batch, 1, 1, low=0.5, high=3))).clamp(
        0.0, 1.0
    )
    field = torch.stack([height + rocks, share], 1)
    return Terrain(wrap(field), draw.uniform(batch, low=5.0, high=12.0))


def _rock(draw: Draw, batch: int, size: int) -> Tensor:
    """[B, n, n] metres: a round to square dome somewhere; for some scenes none."""
    axis = torch.arange(size, device=draw.device) / size
    middle = draw.uniform(batch, 2)
    radius = draw.uniform(batch, 1, 1, low=0.01, high=0.07)
    tall = draw.uniform(batch, 1, 1, low=0.1, high=0.9) * draw.chance(0.7, batch, 1, 1)
    power = draw.uniform(batch, 1, 1, low=2.0, high=8.0)
    x = (axis[None, None] - middle[:, 0, None, None] + 0.5) % 1.0 - 0.5
    y = (axis[None, :, None] - middle[:, 1, None, None] + 0.5) % 1.0 - 0.5
    distance = ((x / radius).abs() ** power + (y / radius).abs() ** power).clamp_max(1.0)
    return tall * torch.sqrt(1.0 - distance)


def _solids(draw: Draw, batch: int) -> Solids:
    kind = draw.whole(batch, SOLIDS, below=3)
    body = draw.log_uniform(batch, SOLIDS, 3, low=0.08, high=0.7)
    length = draw.uniform(batch, SOLIDS, 1, low=2.0, high=8.0)
    pipe = torch.cat([length, draw.uniform(batch, SOLIDS, 2, low=0.04, high=0.3)], -1)
    half = torch.where((kind == 2)[..., None], pipe, body)
    middle = [
        draw.uniform(batch, SOLIDS, 2, low=-3.5, high=3.5),
        draw.uniform(batch, SOLIDS, 1, low=-0.1, high=0.8),
    ]
    there = draw.uniform(batch, SOLIDS) < draw.uniform(batch, 1, high=0.8)
    turn = draw.normal(batch, SOLIDS, 3, sigma=1.2)
    return Solids(rotation(turn), torch.cat(middle, -1), half, kind == 1, there)


def _light(draw: Draw, batch: int, size: int) -> Light:
    tilt = draw.uniform(batch, 2, low=-1.0, high=1.0)
    sun = F.normalize(torch.cat([tilt, torch.ones_like(tilt[:, :1])], -1), dim=-1)
    waves = spectral(draw, size, draw.uniform(batch, low=1.5, high=2.5))
    lamp = draw.uniform(batch, 3, low=-0.4, high=0.4) * torch.tensor(
        [1.0, 1.0, 0.2], device=draw.device
    )
    return Light(
        sun,
        draw.uniform(batch, low=0.25, high=0.8),
        draw.chance(0.4, batch) * draw.uniform(batch, low=0.3, high=1.0),
        lamp,
        draw.chance(0.35, batch) * draw.uniform(batch, low=0.1, high=0.6),
        wrap(torch.exp(-4.0 * waves.abs())[:, None]),
    )


def rotation(
    vector: Tensor,  # [..., 3] radians
) -> Tensor:
    """[..., 3, 3] exp of the rotation vectors."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    R: Tensor = torch.linalg.matrix_exp(torch.stack([torch.stack(r, -1) for r in rows], -2))
    return R
