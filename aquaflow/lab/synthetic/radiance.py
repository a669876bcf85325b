"""What the sea floor looks like without water: albedo times soft, static light.

The light is fixed to the world (diffuse daylight and a weak sun), so that the clean radiance of a
point is the same from everywhere, as the image formation demands. It is computed once, as a texture
of radiance over the floor.
"""

from __future__ import annotations

import numpy as np

from aquaflow.lab.synthetic import hull
from aquaflow.lab.synthetic.config import SceneKind
from aquaflow.lab.synthetic.noise import FloatMap, blur, fractal, resize, smoothstep
from aquaflow.lab.synthetic.relief import Relief

TEXELS_PER_CELL = 2
"""Texels of the colours along an edge of the relief's cell."""
SUN_DIRECTION = np.array([-0.45, 0.35, 0.82]) / np.linalg.norm([-0.45, 0.35, 0.82])
"""Towards the sun: x, y of the survey frame, and up."""
AMBIENT = 0.55
SUN = 0.62
"""Share of the light from all around, and from the sun; a horizontal white plane reflects ~1."""


def bake(
    kind: SceneKind,
    relief: Relief,
    casters: FloatMap,  # [H, W] m
    rng: np.random.Generator,
) -> FloatMap:
    """Radiance [2 H, 2 W, 3] in [0, 1] over the relief's area, and as a fourth channel steepness.

    Steepness is 0 below 35 degrees and 1 above 60: there a map seen from above has too few texels,
    and the renderer adds grain that runs with the height.

    Args:
        kind: scene.
        relief: height and cover.
        casters: [H, W] m, the relief with the objects' tops, for shade on the ground.
        rng: of the colours.
    """
    rows, columns = relief.area.shape
    shape = (rows * TEXELS_PER_CELL, columns * TEXELS_PER_CELL)
    texel = relief.area.cell / TEXELS_PER_CELL
    micro = fractal(rng, shape, texel, 0.12, 0.0, 0.75)
    colour = _albedo(kind, relief, micro, shape, texel, rng)
    colour *= _light(relief, casters, micro, shape, texel)[..., None]
    np.clip(colour, 0.004, 0.98, out=colour)
    dy, dx = np.gradient(relief.height, relief.area.cell)
    steep = smoothstep(np.hypot(dx, dy).astype(np.float32), 0.7, 1.7)
    steep = np.clip(resize(steep, shape), 0.0, 1.0)[..., None]
    # On a steep face the few pixels of the map would be stretched to stripes.
    colour += np.float32(0.8) * steep * (blur(colour, 0.02 / texel) - colour)
    return np.concatenate([colour, steep], axis=-1)


def _albedo(
    kind: SceneKind,
    relief: Relief,
    micro: FloatMap,  # [2 H, 2 W] noise
    shape: tuple[int, int],
    texel: float,
    rng: np.random.Generator,
) -> FloatMap:
    if kind == "hull":
        return hull.painted_plates(relief.area, shape, texel, rng)
    cover = np.clip(resize(relief.cover, shape), 0.0, 1.0)
    broad = fractal(rng, shape, texel, 3.0, 0.0, 0.72)
    spots = fractal(rng, shape, texel, 0.20, 0.0, 0.85)
    sand = np.array([0.60, 0.53, 0.42], np.float32) * (1.0 + 0.10 * broad + 0.14 * micro)[..., None]
    _mix(sand, smoothstep(spots, 1.1, 1.7), (0.88, 0.85, 0.78), 0.8)
    _mix(sand, smoothstep(-spots, 1.1, 1.7), (0.16, 0.14, 0.12), 0.8)
    rock = resize(relief.tint, shape) * (1.0 + 0.22 * broad + 0.24 * micro)[..., None]
    algae = fractal(rng, shape, texel, 0.8, 0.0, 0.6)
    _mix(rock, smoothstep(algae, 0.2, 0.9), (0.30, 0.33, 0.15), 0.55)
    _mix(rock, smoothstep(-algae + 0.5 * broad, 0.7, 1.2), (0.58, 0.34, 0.38), 0.65)
    _mix(rock, smoothstep(spots + 0.5 * micro, 1.2, 1.8), (0.80, 0.76, 0.66), 0.7)
    _mix(rock, smoothstep(-spots + 0.5 * micro, 1.1, 1.6), (0.10, 0.09, 0.08), 0.7)
    if kind in ("flat_sand", "pipe"):
        film = smoothstep(algae + 0.6 * broad, 0.5, 1.6)
        _mix(sand, film, (0.36, 0.34, 0.22), 0.6)
    sand += cover[..., None] * (rock - sand)
    return np.maximum(sand, np.float32(0.02))


def _mix(
    colour: FloatMap,  # [H, W, 3]
    weight: FloatMap,  # [H, W]
    other: tuple[float, float, float],
    share: float,
) -> None:
    """Blend ``colour`` [H, W, 3] towards ``other`` where ``weight`` [H, W] is 1, in place."""
    weight = (np.float32(share) * weight)[..., None]
    colour += weight * (np.asarray(other, np.float32) - colour)


def _light(
    relief: Relief,
    casters: FloatMap,  # [H, W] m
    micro: FloatMap,  # [2 H, 2 W] noise
    shape: tuple[int, int],
    texel: float,
) -> FloatMap:
    """Light [2 H, 2 W] that reaches the ground, from normals, hollows and shadows."""
    cover = np.clip(resize(relief.cover, shape), 0.0, 1.0)
    height = resize(relief.height, shape) + (0.0006 + 0.0016 * cover) * micro
    dy, dx = np.gradient(height, texel)
    norm = 1.0 / np.sqrt(1.0 + dx * dx + dy * dy)
    sx, sy, sz = (np.float32(v) for v in SUN_DIRECTION)
    facing = np.maximum((sz - sx * dx - sy * dy) * norm, 0.0)
    coarse = _openness(casters, relief.area.cell)
    shadow = _sunlit(casters, relief.area.cell)
    fine = np.clip(1.0 + (height - blur(height, 0.012 / texel)) / 0.012, 0.55, 1.25)
    ambient = AMBIENT * resize(coarse, shape) * fine * (0.6 + 0.4 * norm)
    return np.asarray(ambient + SUN * facing * np.clip(resize(shadow, shape), 0, 1), np.float32)


def _openness(
    height: FloatMap,  # [H, W] m
    cell: float,
) -> FloatMap:
    """How much of the sky a point sees, [H, W]: lower than its surroundings is darker."""
    total = np.ones_like(height)
    for radius, weight in ((0.04, 0.35), (0.15, 0.45), (0.45, 0.35)):
        sunk = (height - blur(height, radius / cell)) / np.float32(radius)
        total *= np.clip(1.0 + np.float32(weight) * sunk, 0.45, 1.15)
    return total


def _sunlit(
    height: FloatMap,  # [H, W] m
    cell: float,
) -> FloatMap:
    """1 in the sun, 0 in the shade, with a half-shade that widens with distance; [H, W]."""
    along = SUN_DIRECTION[:2] / np.linalg.norm(SUN_DIRECTION[:2])
    rise = SUN_DIRECTION[2] / np.linalg.norm(SUN_DIRECTION[:2])
    padded = np.zeros_like(height)
    worst = np.full_like(height, -np.inf)
    rows, columns = height.shape
    for distance in np.geomspace(0.03, 1.0, 18):
        shift_x, shift_y = (round(float(v) * distance / cell) for v in along)
        if max(abs(shift_x), abs(shift_y)) >= min(rows, columns):
            break
        padded[:] = -np.inf
        to_y, from_y = _overlap(rows, shift_y)
        to_x, from_x = _overlap(columns, shift_x)
        padded[to_y, to_x] = height[from_y, from_x]
        above = (padded - height) / np.float32(distance) - np.float32(rise)
        np.maximum(worst, above, out=worst)
    return blur(1.0 - smoothstep(worst, -0.35, 0.35), 0.01 / cell)


def _overlap(count: int, shift: int) -> tuple[slice, slice]:
    """Where values shifted by ``shift`` land, and where they come from."""
    return (
        slice(max(0, -shift), count - max(0, shift)),
        slice(max(0, shift), count - max(0, -shift)),
    )
