"""The man-made objects of a scene and their poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic import pool
from aquaflow.lab.synthetic.config import SceneKind
from aquaflow.lab.synthetic.objects import Rgb, Solid
from aquaflow.lab.synthetic.relief import Relief

Array: TypeAlias = npt.NDArray[np.float64]

NET_ROPES_M = 2.5
"""Between the upright ropes of a net cage."""


def place_objects(
    kind: SceneKind,
    relief: Relief,
    loop: Array,  # [N, 2] m
    rng: np.random.Generator,
) -> list[Solid]:
    """The objects of a scene, next to the vehicle's path and in view of its camera."""
    low, high = loop.min(axis=0), loop.max(axis=0)

    def ground(x: float, y: float) -> float:
        return float(relief.area.sample(relief.height, np.array([[x, y]]))[0])

    shapes: list[Solid] = []
    if kind == "pipe":
        shapes = _pipeline(low, high, ground, rng)
    elif kind == "flat_sand":
        x, y = high[0] + rng.uniform(0.8, 1.2), low[1] - rng.uniform(0.6, 0.9)
        shapes = [_crate(x, y, ground(x, y), 0.16, rng)]
    elif kind == "pool":
        shapes = [*pool.tiled_basin(*pool.corners(loop), rng), *_in_pool(low, high, rng)]
    elif kind == "net":
        shapes = [netting(low, high, rng), *_frame_of_net(low, high)]
    elif kind == "wall":
        y = high[1] + 0.9
        shapes = [_rope((low[0] - 1.0, y, 0.35), (high[0] + 4.0, y + 0.2, 0.4))]
    elif kind == "reef":
        shapes = _on_reef(low, high, ground, rng)
    return shapes


def _on_reef(
    low: Array,  # [2] m
    high: Array,  # [2] m
    ground: Callable[[float, float], float],
    rng: np.random.Generator,
) -> list[Solid]:
    """A crate, a mooring, a pipe and a ball, ahead of the lanes and beside them."""
    x, y = high[0] + rng.uniform(0.5, 0.9), low[1] - rng.uniform(0.6, 0.8)
    shapes = [_crate(x, y, ground(x, y), 0.22, rng)]
    x, y = high[0] + rng.uniform(0.2, 0.5), high[1] + rng.uniform(0.8, 1.1)
    shapes += _mooring(x, y, ground(x, y), rng)
    a = np.array([high[0] + 1.7, low[1] - 1.8])
    b = np.array([high[0] + 2.9, high[1] + 1.4])
    ends = [(*p, ground(*p) + 0.10) for p in (a, b)]
    shapes.append(_cylinder(ends[0], ends[1], 0.11, (0.42, 0.40, 0.36), (0.42, 0.30, 0.22), 0.6))
    x, y = low[0] + 1.2, low[1] - 1.1
    shapes.append(_ball(x, y, ground(x, y) + 0.08, 0.14, rng))
    return shapes


def _in_pool(
    low: Array,  # [2] m
    high: Array,  # [2] m
    rng: np.random.Generator,
) -> list[Solid]:
    """Crates and a mooring on the tiles, on both sides of the way, and a rope across."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    shapes = []
    for k in range(5):
        angle, out = rng.uniform(0.0, 0.8) + 1.26 * k, rng.choice([0.45, 1.3])
        x, y = middle + out * half * (math.cos(angle), math.sin(angle))
        shapes.append(_crate(x, y, 0.0, float(rng.uniform(0.1, 0.2)), rng))
    shapes += _mooring(middle[0] + 0.3, middle[1] + rng.uniform(-0.2, 0.2), 0.0, rng)
    ends = (low[0] - 1.2, low[1] - 0.3, 1.9), (high[0] + 1.2, high[1] + 0.5, 1.6)
    return [*shapes, _rope(*ends)]


def _frame_of_net(
    low: Array,  # [2] m
    high: Array,  # [2] m
) -> list[Solid]:
    """Ropes up and across, on which the net hangs."""
    ends = low - NET_ROPES_M, high + 2.0 * NET_ROPES_M
    up = [
        _rope((ends[0][0], y, 0.02), (ends[1][0], y, 0.02))
        for y in np.arange(ends[0][1], ends[1][1], NET_ROPES_M).tolist()
    ]
    middle = 0.5 * (low[0] + high[0])
    return [*up, _rope((middle, ends[0][1], 0.03), (middle, ends[1][1], 0.03))]


def _pipeline(
    low: Array,  # [2] m
    high: Array,  # [2] m
    ground: Callable[[float, float], float],
    rng: np.random.Generator,
) -> list[Solid]:
    y = float(0.5 * (low[1] + high[1]))
    radius = 0.17
    drift = float(rng.uniform(0.2, 0.5))
    start, end = (low[0] - 3.0, y - drift, 0.09), (high[0] + 14.0, y + drift, 0.06)
    shapes = [_cylinder(start, end, radius, (0.46, 0.44, 0.40), (0.30, 0.30, 0.16), 0.5)]
    along = np.array(end) - np.array(start)
    for distance in np.arange(1.0, np.linalg.norm(along), 1.6):
        # Anode bracelets and field joints, as on real lines.
        middle = np.array(start) + along * (distance / np.linalg.norm(along))
        half = along / np.linalg.norm(along) * rng.uniform(0.06, 0.18)
        ends = tuple(middle - half), tuple(middle + half)
        shapes.append(
            _cylinder(ends[0], ends[1], radius + 0.018, (0.62, 0.60, 0.56), (0.35, 0.24, 0.16), 0.4)
        )
    return shapes


def _cylinder(
    a: tuple[float, ...],
    b: tuple[float, ...],
    radius: float,
    paint: Rgb,
    growth: Rgb,
    covered: float,
) -> Solid:
    start, end = np.asarray(a, float), np.asarray(b, float)
    along = end - start
    length = float(np.linalg.norm(along))
    x = along / length
    helper = np.array([0.0, 0.0, 1.0]) if abs(x[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    y = np.cross(helper, x)
    y /= np.linalg.norm(y)
    R = np.stack([x, y, np.cross(x, y)], axis=1)
    size = (0.5 * length, radius, radius)
    return Solid("cylinder", 0.5 * (start + end), R, size, paint, growth, covered)


def _rope(a: tuple[float, float, float], b: tuple[float, float, float]) -> Solid:
    return _cylinder(a, b, 0.014, (0.60, 0.52, 0.34), (0.28, 0.26, 0.16), 0.4)


def _crate(x: float, y: float, ground: float, half: float, rng: np.random.Generator) -> Solid:
    turn, lean = rng.uniform(0.3, 1.2), rng.uniform(-0.12, 0.12)
    c, s = math.cos(turn), math.sin(turn)
    tilt = np.array(
        [[math.cos(lean), 0, math.sin(lean)], [0, 1, 0], [-math.sin(lean), 0, math.cos(lean)]]
    )
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ tilt
    size = (half * 1.4, half, half * 0.9)
    centre = np.array([x, y, ground + 0.65 * half])
    return Solid("box", centre, R, size, (0.55, 0.40, 0.18), (0.26, 0.24, 0.15), 0.45)


def _ball(x: float, y: float, z: float, radius: float, rng: np.random.Generator) -> Solid:
    paint = (0.78, 0.36 + 0.1 * float(rng.uniform()), 0.10)
    return Solid(
        "sphere", np.array([x, y, z]), np.eye(3), (radius,) * 3, paint, (0.30, 0.32, 0.2), 0.35
    )


def _mooring(x: float, y: float, ground: float, rng: np.random.Generator) -> list[Solid]:
    """A concrete block with a rope up to a float."""
    turn = rng.uniform(0.0, 1.5)
    c, s = math.cos(turn), math.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    block = Solid(
        "box", np.array([x, y, ground + 0.1]), R, (0.2, 0.2, 0.14), (0.60, 0.58, 0.54),
        (0.34, 0.34, 0.2), 0.5,
    )  # fmt: skip
    top = (x + 0.05, y + 0.1, ground + 0.75)
    return [block, _rope((x, y, ground + 0.2), top), _ball(*top, 0.09, rng)]


# --------------------------------------------------------------------------------------------------
# The side of a net cage: twine of equal meshes with open water behind, on a frame of ropes.

BEHIND_M = 40.0
"""To the next solid thing behind the net: farther than anything is seen."""
MESHES_M = (0.03, 0.05)
"""Range of a mesh's edge; salmon cages have 20 to 30 mm, predator nets more."""
TWINE_SHARE = 0.11
"""Thickness of the twine over the edge of a mesh, new and a little fouled."""
MARGIN_M = 8.0
"""Around the vehicle's way: what an oblique view reaches."""
TWINE, FOULING = (0.52, 0.55, 0.50), (0.34, 0.30, 0.16)
"""Albedo, RGB."""


def netting(
    low: Array,  # [2] m
    high: Array,  # [2] m
    rng: np.random.Generator,
) -> Solid:
    """The net in the plane z = 0, round the way from ``low`` to ``high``, a little askew."""
    mesh = float(rng.uniform(*MESHES_M))
    turn = float(rng.uniform(-0.1, 0.1))
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    half = 0.5 * (high - low) + MARGIN_M
    centre = np.array([*(0.5 * (low + high)), 0.0])
    size = (float(half[0]), float(half[1]), 0.01)
    return Solid(
        "net", centre, R, size, TWINE, FOULING, 0.35, mesh_m=mesh, twine_m=TWINE_SHARE * mesh
    )
