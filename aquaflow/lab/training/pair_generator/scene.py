"""What is looked at: a sea floor with rocks, loose bodies and pipes, and the light on them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.noise import Draw, periodic, spectral, stamp, wrap

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


# --------------------------------------------------------------------------------------------------
# Albedo that repeats itself: tiled floors, brickwork and nets, unlike only by their dirt.
#
# Their cells are alike, so that only what lies around a cell says which one it is.

CELLS = (3, 14)
"""Half the number of cells along a period; a whole even number of them keeps it periodic."""
JOINT = (0.04, 0.2)
"""Width of a joint or a twine, as a share of its cell."""
SAG = 0.15
"""Deviation of a net's displacement, in cells."""
NETS = 0.35
"""Share of nets; the others are tiles and bricks."""


def regular_albedo(draw: Draw, batch: int, size: int) -> Tensor:
    """[B, 3, size, size] in [0, 1], periodic."""
    count = 2.0 * (draw.whole(batch, 1, 1, below=CELLS[1] - CELLS[0]) + CELLS[0])
    is_net = draw.chance(NETS, batch, 1, 1)
    u, v = _places(draw, count, is_net, size)
    joint = draw.log_uniform(batch, 1, 1, low=JOINT[0], high=JOINT[1])
    soft = count / size
    lines = torch.maximum(_line(u, joint, soft), _line(v, joint, soft))
    tile = _cell_values(draw, u, v, count)
    dirt = spectral(draw, size, draw.uniform(batch, low=1.2, high=2.6))
    dirt = 1.0 + draw.log_uniform(batch, 1, 1, low=0.02, high=0.25) * dirt
    colours = draw.uniform(2, batch, 3, 1, 1, low=0.05, high=0.9)
    colours = colours.mean(2, keepdim=True).lerp(colours, draw.uniform(batch, 1, 1, 1))
    # Behind a net there is open water or a dim background, and nothing that belongs to a cell.
    background = torch.where(is_net, 0.3 * dirt, tile * dirt)[:, None]
    result = (colours[0] * background).lerp(colours[1] * dirt[:, None], lines[:, None])
    growth = stamp(
        draw,
        size,
        draw.log_uniform(batch, low=1e-5, high=3e-4),
        draw.log_uniform(batch, low=2.0, high=9.0),
        torch.zeros(batch, device=draw.device),
    )[:, None]
    thing = draw.uniform(batch, 3, 1, 1, low=0.05, high=0.7)
    return result.lerp(thing * dirt[:, None], growth).clamp(0.01, 1.0)


def _places(
    draw: Draw,
    count: Tensor,  # [B, 1, 1]
    is_net: Tensor,  # [B, 1, 1] bool
    size: int,
) -> tuple[Tensor, Tensor]:
    """[B, size, size] along and across, in cells: straight, every second row shifted by half a
    cell, or for nets along the diagonals and sagging."""
    batch = len(count)
    axis = (torch.arange(size, device=draw.device) + 0.5) / size
    x = (axis[None, None] * count).expand(-1, size, -1)
    y = (axis[None, :, None] * count).expand(-1, -1, size)
    brick = draw.chance(0.3, batch, 1, 1) * 0.5
    straight = (x + brick * (y.floor() % 2.0), y)
    sag = [SAG * spectral(draw, size, torch.full((batch,), 3.5, device=draw.device)) for _ in "uv"]
    diagonal = draw.chance(0.5, batch, 1, 1)
    net = (
        torch.where(diagonal, x + y, x) + sag[0],
        torch.where(diagonal, x - y, y) + sag[1],
    )
    return torch.where(is_net, net[0], straight[0]), torch.where(is_net, net[1], straight[1])


def _line(
    place: Tensor,  # [B, n, n] in cells
    width: Tensor,  # [B, 1, 1] in cells
    soft: Tensor,  # [B, 1, 1] cells to a texel
) -> Tensor:
    """[B, n, n] in [0, 1], 1 on the cells' borders."""
    away = 0.5 - (place - place.floor() - 0.5).abs()
    return ((0.5 * width - away) / soft + 0.5).clamp(0.0, 1.0)


def _cell_values(
    draw: Draw,
    u: Tensor,  # [B, n, n]
    v: Tensor,  # [B, n, n]
    count: Tensor,  # [B, 1, 1]
) -> Tensor:
    """[B, n, n] brightness of each cell: nearly alike, a few of another glaze."""
    batch, most = len(count), 2 * CELLS[1]
    shade = 1.0 + draw.normal(batch, most * most) * draw.uniform(batch, 1, high=0.06)
    other = draw.uniform(batch, most * most) < draw.uniform(batch, 1, high=0.12)
    shade = torch.where(other, shade * draw.uniform(batch, 1, low=0.4, high=1.5), shade)
    column, row = ((x.floor() % count).long().clamp(0, most - 1) for x in (u, v))
    return shade.gather(1, (row * most + column).flatten(1)).view_as(u)


# --------------------------------------------------------------------------------------------------
# Albedo of floors and structures, with a pyramid so that nothing flickers with distance.

LEVELS = 7
"""Of the pyramid; the coarsest has 1/64 of the texels along a side."""
SHARPNESS = 0.7
"""Share of a pixel's width that is averaged: lenses are sharper than a full pixel's mean."""


@dataclass(frozen=True)
class Atlas:
    """Pyramids of several periodic textures in one picture, so that a lookup is one gather."""

    picture: Tensor
    """[B, 3, rows, columns]; each level has its first row and column once more"""
    size: int
    """Texels along a side of the finest level."""
    row: Tensor
    """[LEVELS] first row of each level."""

    @property
    def width(self) -> int:
        """Columns that one texture takes."""
        return self.size + 1

    def albedo(
        self,
        places: Tensor,  # [B, N, 2] in periods
        footprint: Tensor,  # [B, N] periods that a pixel covers
        material: Tensor,  # [B, N] int64, which texture
    ) -> Tensor:
        """[B, 3, N] trilinear."""
        level = torch.log2((footprint * self.size * SHARPNESS).clamp_min(1.0))
        level = level.clamp_max(LEVELS - 1.001)
        fine = level.floor()
        near = self._level(places, fine.long(), material)
        far = self._level(places, fine.long() + 1, material)
        return near + (far - near) * (level - fine)[:, None]

    def _level(
        self,
        places: Tensor,  # [B, N, 2] in periods
        level: Tensor,  # [B, N] int64
        material: Tensor,  # [B, N] int64
    ) -> Tensor:
        scale = torch.exp2(level.float())[..., None]
        # The mean of 2^l texels lies at their middle, not at the first of them.
        places = places - (scale - 1.0) / (2.0 * self.size)
        inside = (places - places.floor()) * (self.size / scale)
        x = inside[..., 0] + (material * self.width).float()
        y = inside[..., 1] + self.row.to(level.device)[level].float()
        rows, columns = self.picture.shape[-2:]
        grid = torch.stack([x / (columns - 1), y / (rows - 1)], -1) * 2.0 - 1.0
        return F.grid_sample(self.picture, grid[:, :, None], mode="bilinear", align_corners=True)[
            ..., 0
        ]


def atlas(
    textures: list[Tensor],  # each [B, 3, n, n] periodic
) -> Atlas:
    """The pyramids of all textures, side by side."""
    size = textures[0].shape[-1]
    columns = []
    for texture in textures:
        level, stack = texture, []
        for _ in range(LEVELS):
            padded = F.pad(level, (0, 1, 0, 1), mode="circular")
            stack.append(F.pad(padded, (0, size + 1 - padded.shape[-1], 0, 0)))
            level = F.avg_pool2d(level, 2)
        columns.append(torch.cat(stack, -2))
    heights = torch.tensor([0] + [(size >> level) + 1 for level in range(LEVELS - 1)])
    return Atlas(torch.cat(columns, -1), size, heights.cumsum(0))


def albedo(draw: Draw, batch: int, size: int) -> Tensor:
    """[B, 3, size, size] in [0, 1]: three colours of growth, cracks, and things strewn about."""
    fine = spectral(draw, size, draw.uniform(batch, low=0.6, high=1.9))
    blobs = spectral(draw, size, draw.uniform(batch, low=0.6, high=1.9))
    patches = spectral(draw, size, draw.uniform(batch, low=1.6, high=2.6))
    colours = draw.uniform(3, batch, 3, 1, 1, low=0.05, high=0.85)
    # Most of nature is near grey; the water makes the colours.
    colours = colours.mean(2, keepdim=True).lerp(colours, draw.uniform(batch, 1, 1, 1))
    contrast = draw.log_uniform(batch, 1, 1, low=0.1, high=0.5)
    threshold = draw.uniform(batch, 1, 1, high=2.0)
    sharpness = draw.uniform(batch, 1, 1, low=2.0, high=10.0)
    speckles = torch.sigmoid((blobs - threshold) * sharpness)[:, None]
    growth = 0.6 * torch.sigmoid((patches - 0.3) * sharpness)[:, None]
    ground = (1.0 + contrast * fine)[:, None]
    result = (colours[0] * ground).lerp(
        colours[1] * (1.0 + 0.3 * contrast * patches)[:, None], speckles
    )
    result = result.lerp(colours[2] * ground, growth)
    cracks = torch.exp(
        -draw.uniform(batch, 1, 1, low=6.0, high=25.0) * blobs.roll(size // 3, 1).abs()
    )
    result = result * (1.0 - draw.uniform(batch, 1, 1, high=0.7) * cracks)[:, None]
    strewn = stamp(
        draw,
        size,
        draw.log_uniform(batch, low=3e-5, high=3e-3),
        draw.log_uniform(batch, low=1.5, high=12.0),
        draw.uniform(batch, low=-1.0, high=0.9).clamp_min(0.0),
    )[:, None]
    thing = draw.uniform(batch, 3, 1, 1, low=0.05, high=0.95)
    return result.lerp(thing * ground, strewn * draw.uniform(batch, 1, 1, 1)).clamp(0.01, 1.0)
