"""Objects on the sea floor as part of its height map: stones, corals, sponges."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from aquaflow.lab.synthetic.noise import FloatMap
from aquaflow.lab.synthetic.relief import Relief

CLEARWAY_M = 1.0
"""Nothing taller than LOW_M stands nearer than this to the vehicle's way."""
LOW_M = 0.22
"""Largest height of objects under the vehicle."""


@dataclass(frozen=True)
class StampShape:
    """A shape in its own coordinates."""

    radius: float
    """m, nothing reaches further from the centre."""
    shape: Callable[[FloatMap, FloatMap, FloatMap], FloatMap]
    """(x, y, roughness) in m -> height above the ground under the centre, m."""
    colour: tuple[float, float, float]


Maker: TypeAlias = Callable[[np.random.Generator], StampShape]


def scatter(
    relief: Relief,
    maker: Maker,
    count: int,
    rng: np.random.Generator,
    rough: FloatMap,  # [H, W] unit variance
    clear: cKDTree,
) -> None:
    """Set ``count`` stamps at random places, merged by maximum so that they overlap like things."""
    area = relief.area
    extent = np.array(area.shape[::-1]) * area.cell
    places = rng.uniform(0.0, 1.0, (count, 2)) * extent
    from_way = np.asarray(clear.query(places + np.array([area.x0, area.y0]))[0])
    for place, distance in zip(places, from_way, strict=True):
        stamp = maker(rng)
        near = distance < CLEARWAY_M + stamp.radius
        _set(relief, stamp, place, rough, LOW_M if near else math.inf)


def _set(
    relief: Relief,
    stamp: StampShape,
    place: np.ndarray[tuple[int], np.dtype[np.float64]],  # [2] m from the area's corner
    rough: FloatMap,  # [rows, columns] noise of the area
    tallest: float,
) -> None:
    cell = relief.area.cell
    rows, columns = relief.area.shape
    centre = place / cell - 0.5
    reach = stamp.radius / cell + 1.0
    left, right = max(0, int(centre[0] - reach)), min(columns, int(centre[0] + reach) + 2)
    top, bottom = max(0, int(centre[1] - reach)), min(rows, int(centre[1] + reach) + 2)
    if right - left < 2 or bottom - top < 2:
        return
    x = ((np.arange(left, right) - centre[0]) * cell).astype(np.float32)[None, :]
    y = ((np.arange(top, bottom) - centre[1]) * cell).astype(np.float32)[:, None]
    window = (slice(top, bottom), slice(left, right))
    ground = relief.height[window]
    middle = ground[ground.shape[0] // 2, ground.shape[1] // 2]
    shape = np.minimum(stamp.shape(x, y, rough[window]), np.float32(tallest))
    raised = middle + shape
    mask = (raised > ground) & (shape > 0.0)
    relief.height[window] = np.where(mask, raised, ground)
    shade = 1.0 + 0.15 * rough[window][mask][:, None]
    relief.tint[window][mask] = np.asarray(stamp.colour, np.float32) * shade
    relief.cover[window][mask] = 1.0


def boulder(rng: np.random.Generator) -> StampShape:
    """A broken stone: the space under a few random planes, with cracks."""
    radius = float(np.clip(rng.lognormal(-1.6, 0.5), 0.07, 0.5))
    return _stone(rng, radius, cracked=True)


def pebble(rng: np.random.Generator) -> StampShape:
    """A stone of 1.5 to 6 cm."""
    return _stone(rng, float(rng.uniform(0.015, 0.06)), cracked=False)


def _stone(rng: np.random.Generator, radius: float, cracked: bool) -> StampShape:
    count = 7
    turn = rng.uniform(0.0, 2.0 * math.pi) + np.arange(count) * (2.0 * math.pi / count)
    turn += rng.uniform(-0.35, 0.35, count)
    slope = rng.uniform(0.9, 3.0, count)
    reach = radius * rng.uniform(0.6, 0.95, count)
    tilt = rng.uniform(-0.25, 0.25, 2)
    top = radius * rng.uniform(0.45, 0.95)

    def shape(
        x: FloatMap,  # [1, w] m
        y: FloatMap,  # [h, 1] m
        rough: FloatMap,  # [h, w] noise
    ) -> FloatMap:
        height = top + tilt[0] * x + tilt[1] * y
        for k in range(count):
            side = slope[k] * (reach[k] - x * math.cos(turn[k]) - y * math.sin(turn[k]))
            height = np.minimum(height, side)
        if cracked:
            # Narrow where the noise changes sign: cracks that run across the faces.
            height = height - 0.10 * radius * np.exp(-((rough / 0.12) ** 2)) + 0.05 * radius * rough
        return np.asarray(height, np.float32)

    grey = rng.uniform(0.22, 0.55)
    warm = rng.uniform(-0.05, 0.07)
    return StampShape(radius * 1.2, shape, (grey + warm, grey, grey - 0.6 * warm))


def brain_coral(rng: np.random.Generator) -> StampShape:
    """A dome with winding grooves."""
    radius = float(rng.uniform(0.08, 0.3))
    flat = rng.uniform(0.5, 0.9)

    def shape(
        x: FloatMap,  # [1, w] m
        y: FloatMap,  # [h, 1] m
        rough: FloatMap,  # [h, w] noise
    ) -> FloatMap:
        rho = (x * x + y * y) / radius**2
        dome = flat * radius * np.sqrt(np.maximum(1.0 - rho, 0.0))
        winding = np.sin(2.0 * math.pi * (x + 0.02 * rough) / 0.035 + 5.0 * np.sin(y / 0.02))
        return np.asarray(np.where(rho < 1.0, dome + 0.004 * winding, -1.0), np.float32)

    return StampShape(radius, shape, _pick(rng, ((0.55, 0.47, 0.22), (0.45, 0.52, 0.28))))


def table_coral(rng: np.random.Generator) -> StampShape:
    """A plate that stands above the ground, with a lobed edge."""
    radius = float(rng.uniform(0.18, 0.42))
    height = rng.uniform(0.12, 0.28)
    lobes, phase = int(rng.integers(4, 9)), rng.uniform(0.0, 6.28)

    def shape(
        x: FloatMap,  # [1, w] m
        y: FloatMap,  # [h, 1] m
        rough: FloatMap,  # [h, w] noise
    ) -> FloatMap:
        rho = np.sqrt(x * x + y * y) / radius
        edge = 0.85 + 0.09 * np.sin(lobes * np.arctan2(y, x) + phase) + 0.03 * rough
        plate = height + 0.05 * rho + 0.008 * rough
        return np.asarray(np.where(rho < edge, plate, -1.0), np.float32)

    return StampShape(radius, shape, _pick(rng, ((0.50, 0.38, 0.26), (0.35, 0.42, 0.40))))


def branching_coral(rng: np.random.Generator) -> StampShape:
    """A thicket of fingers."""
    radius = float(rng.uniform(0.1, 0.28))
    count = int(rng.integers(12, 36))
    place = rng.normal(0.0, 0.42 * radius, (count, 2))
    tall = rng.uniform(0.35, 0.9, count) * radius
    thick = rng.uniform(0.012, 0.03, count)

    def shape(
        x: FloatMap,  # [1, w] m
        y: FloatMap,  # [h, 1] m
        rough: FloatMap,  # [h, w] noise
    ) -> FloatMap:
        height = np.full(np.broadcast_shapes(x.shape, y.shape), -1.0, np.float32)
        for (cx, cy), top, width in zip(place, tall, thick, strict=True):
            rho = np.sqrt((x - cx) ** 2 + (y - cy) ** 2) / width
            finger = top * (1.0 - 0.35 * rho**2)
            height = np.maximum(height, np.where(rho < 1.0, finger, -1.0))
        return np.asarray(height + 0.004 * rough, np.float32)

    colours = ((0.62, 0.40, 0.36), (0.45, 0.40, 0.60), (0.66, 0.56, 0.36))
    return StampShape(radius * 1.7, shape, _pick(rng, colours))


def sponge(rng: np.random.Generator) -> StampShape:
    """A barrel with an open top."""
    radius = float(rng.uniform(0.05, 0.14))
    height = radius * rng.uniform(1.0, 1.8)

    def shape(
        x: FloatMap,  # [1, w] m
        y: FloatMap,  # [h, 1] m
        rough: FloatMap,  # [h, w] noise
    ) -> FloatMap:
        rho = np.sqrt(x * x + y * y) / radius
        ribs = 0.06 * np.cos(11.0 * np.arctan2(y, x))
        barrel = height * (1.0 - 0.8 * np.exp(-((rho / 0.45) ** 2))) * (1.0 + ribs)
        return np.asarray(np.where(rho < 1.0 + ribs, barrel + 0.005 * rough, -1.0), np.float32)

    return StampShape(radius * 1.1, shape, _pick(rng, ((0.70, 0.42, 0.18), (0.60, 0.22, 0.20))))


def _pick(
    rng: np.random.Generator, colours: tuple[tuple[float, float, float], ...]
) -> tuple[float, float, float]:
    red, green, blue = np.asarray(colours[int(rng.integers(len(colours)))]) * rng.uniform(0.8, 1.2)
    return float(red), float(green), float(blue)
