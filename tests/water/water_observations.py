"""Observations of surface points through known water, and the fit to them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from aquaflow.config import WaterPriorsConfig
from aquaflow.water.estimation import EVERY_MODEL, WaterEstimate, estimating
from aquaflow.water.model import BELIEVED, Model, WaterModel, shading_basis
from aquaflow.water.observations import Observations, run_to_end

Array = npt.NDArray[np.float64]
BETA = np.array([0.6, 0.3, 0.2])
B_INF = np.array([0.1, 0.3, 0.4])
B = np.array([0.7, 0.35, 0.25])
B_RES, D = np.full(3, 0.01), np.ones(3)
LAMP = np.array([0.0, 0.1, -0.35, 0.0, -0.4])


def sighted(
    seed: int = 0,
    points: int = 300,
    sightings: int = 4,
    noise: float = 0.005,
    shading: Array | None = None,
    water: bool = True,
    log_gains: Array | None = None,  # [sightings, 3], view k holds the k-th sighting of each point
) -> Observations:
    """Sightings of points whose colours span black to bright, through known water or none."""
    rng = np.random.default_rng(seed)
    J = rng.uniform(0.0, 0.9, (points, 1)) * rng.uniform(0.7, 1.0, (points, 3))
    point = np.repeat(np.arange(points), sightings)
    z = rng.uniform(0.5, 3.0, len(point))
    xy = rng.uniform(-0.95, 0.95, (len(point), 2))
    # Near ground is seen near the lower edge: the case in which a lamp looks like water.
    xy[:, 1] = np.clip(0.95 - 0.5 * z + 0.4 * xy[:, 1], -0.95, 0.95)
    path, seen = z[:, None], J[point]
    view = np.tile(np.arange(sightings), points)
    if water:
        veil = B_INF * -np.expm1(-B * path) + B_RES * np.exp(-D * path)
        seen = seen * np.exp(-BETA * path) + veil
    if log_gains is not None:
        seen = seen * np.exp(log_gains)[view]
    if shading is not None:
        seen = seen * np.exp(shading_basis(xy) @ shading)[:, None]
    # Colours and ranges have nothing to do with the place: near and far are alike.
    positions = rng.uniform(-1.0, 1.0, (points, 3))
    seen = seen + noise * rng.normal(size=seen.shape)
    return Observations(point, view, seen, z, xy, positions)


def estimate_water(
    seen: Observations,
    B_res: Array,  # [3]
    d: Array,  # [3] 1 / map unit
    models: Sequence[Model] = EVERY_MODEL,
    priors: WaterPriorsConfig = BELIEVED,
) -> WaterEstimate | None:
    """The whole fit, its pauses left out."""
    return run_to_end(estimating(seen, B_res, d, models, priors))


def fitted(seen: Observations) -> WaterEstimate:
    estimate = estimate_water(seen, B_RES, D)
    assert estimate is not None
    return estimate


def assert_derivatives_are_finite_differences(problem: WaterModel, c: int, spread: float) -> None:
    """Of channel ``c``, around parameters drawn ``spread`` from the start, at their J."""
    rng, seen = np.random.default_rng(0), problem.seen
    x = problem.start + spread * rng.normal(size=problem.size)
    J = problem.predict(x).J

    def errors(at: Array) -> Array:
        now = problem.predict(at)
        return np.asarray(now.a[c] * J[c, seen.point] + now.backscatter[c] - seen.colour[:, c])

    found = problem.derivatives(problem.predict(x), np.ones(len(seen.z)), c)
    for k, row in zip(found.own, found.direct, strict=True):
        step = np.zeros(problem.size)
        step[k] = 1e-6
        np.testing.assert_allclose(row, (errors(x + step) - errors(x - step)) / 2e-6, atol=1e-6)
