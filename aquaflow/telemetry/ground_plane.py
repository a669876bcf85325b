"""The ground that cameras look squarely at: what is down, for want of anything that measures it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.optimise.robust import Cauchy, sigma_of

Array = npt.NDArray[np.float64]

ROUNDS = 10
"""Of weighted fits; five or six leave less than 0.1 degrees."""
KERNEL = Cauchy(2.4)
"""Of distances from the plane."""
LEAST_POINTS = 30
"""Of a ground; fewer are none."""
LARGEST_RELIEF = 0.5
"""Thickness of what has a plane, over its lesser width, both as standard deviations: judgement.
The ground of the surveys 1, 3, 6 and 7 has 0.07 to 0.19, an even ball has 1."""
LARGEST_LOOK_DEG = 30.0
"""Between the cameras' viewing directions, by their mean cosine, and the normal of what they show,
up to which that plane is taken for the ground, seen squarely. The mean direction of the surveys 1,
3, 6 and 7, which look down, has 14, 4, 2 and 10; that of the reef clip, which looks ahead, 61."""
SLOPE_SIGMA = float(np.radians(10.0))
"""rad, 1 sigma of the slope about each level axis of ground that is taken to be level: what the
cameras of those surveys, on a vehicle that keeps level, see of it is 9 degrees in the mean."""


def mean_normal(
    points: Array,  # [K, 3]
    weights: Array,  # [K]
) -> Array | None:
    """[3] unit normal of the plane that the points lie about, of either sign; None where they lie
    about none."""
    if len(points) < LEAST_POINTS:
        return None
    equal = weights
    for _ in range(ROUNDS):
        offset = points - np.average(points, axis=0, weights=weights)
        spread, axes = np.linalg.eigh((weights[:, None] * offset).T @ offset / weights.sum())
        across = offset @ axes[:, 0]
        weights = equal * KERNEL.weight(across / max(sigma_of(across), 1e-12))
    if spread[0] > LARGEST_RELIEF**2 * spread[1]:
        return None
    return np.asarray(axes[:, 0])


def down_into_ground(
    points: Array,  # [K, 3] of what the cameras see
    weights: Array,  # [K]
    looks: Array,  # [N, 3] unit viewing directions
) -> Array | None:
    """[3] unit, into the ground across its mean plane; None where none is seen squarely."""
    down = mean_normal(points, weights)
    if down is None:
        return None
    look = np.mean(looks, axis=0)
    down = down * np.sign(down @ look)
    return down if down @ look >= np.cos(np.radians(LARGEST_LOOK_DEG)) else None
