"""Exact matches of a camera that swims over a floor, with an error of its lens."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.optics import rays_of, seen_at
from aquaflow.geometry.similarity import so3_exp
from aquaflow.tracking.lens_equations import LensObservations

Array = npt.NDArray[np.float64]

FOCAL_PX = 400.0
NOISE = 0.1 / FOCAL_PX
HALF = np.array([0.6, 0.45])
"""Half a picture on the normalised plane."""


def swim(
    lens: tuple[float, ...],
    turning: float = 0.1,
    relief: float = 0.3,
    views: int = 7,
    seed: int = 0,
    reach: int = 2,
) -> tuple[LensObservations, Array, Array]:
    """Matches of a camera with an error of its lens that swims over a floor, and its poses; every
    view is matched with the next ``reach``."""
    rng = np.random.default_rng(seed)
    error = np.zeros(5)
    error[: len(lens)] = lens
    R = np.stack([so3_exp(rng.normal(0.0, turning, 3)) for _ in range(views)])
    centres = np.stack([(0.2 * i, 0.1 * (i % 2), 0.0) for i in range(views)])
    points, reference, point, view, matches = [], [], [], [], []
    for i in range(views):
        seen = rng.uniform(-HALF, HALF, (120, 2))
        rays = np.concatenate([rays_of(seen, error), np.ones((120, 1))], axis=1) @ R[i].T
        floor = rng.normal(1.0, relief, 120).clip(0.4, 1.6)
        world = centres[i] + rays * (floor / rays[:, 2])[:, None]
        first = len(points)
        points += list(seen)
        reference += [i] * 120
        for j in range(i + 1, i + 1 + reach):
            if j >= views:
                continue
            Y = (world - centres[j]) @ R[j]
            match = seen_at(Y[:, :2] / Y[:, 2:], error)
            inside = (np.abs(match) < HALF).all(axis=1)
            match += rng.normal(0.0, NOISE, match.shape)
            point += list(first + np.flatnonzero(inside))
            view += [j] * int(inside.sum())
            matches += list(match[inside])
    found = LensObservations(
        np.array(points), np.array(reference), np.array(point), np.array(view), np.array(matches)
    )
    # What tracking made of it is near the truth, not the truth.
    return found, R, centres + rng.normal(0.0, 0.005, centres.shape)
