"""Heights along a straight line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.survey.measure.points import MeasuredPoints
from aquaflow.survey.measure.quantity import NORMAL_95, Quantity
from aquaflow.survey.measure.scale import Scale

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class GroundProfile:
    """The ground along a line."""

    along: Array
    """[N] horizontal distance from the first point towards the last one."""
    height: Array
    """[N] above zero of the points' frame."""
    sigma: Array
    """[N] 1 sigma of the height against the mean of the line: what the whole line errs together
    is no error of its shape."""
    drop: Quantity
    """Height of the last point above the first; negative where the ground falls."""
    unit: str
    """Of all of them."""

    @property
    def low(self) -> Array:
        """[N] lower end of each height's 95 % interval."""
        return self.height - NORMAL_95 * self.sigma

    @property
    def high(self) -> Array:
        """[N] upper end."""
        return self.height + NORMAL_95 * self.sigma


def profile(
    points: MeasuredPoints,
    up: Array,  # [3] unit, in the points' frame; (0, 0, -1) in a level n
    scale: Scale,
) -> GroundProfile:
    """The heights of points on a line, in its order.

    Raises:
        InputError: there are fewer than two points, or the last is right above the first.
    """
    count = len(points.places)
    if count < 2:
        raise InputError("a profile needs 2 points at least; mark another one")
    height = points.places @ up
    flat = points.places - height[:, None] * up
    line = flat[-1] - flat[0]
    length = float(np.linalg.norm(line))
    if length <= 0.0:
        raise InputError("the ends of a profile lie above each other; mark them farther apart")
    along = (flat - flat[0]) @ (line / length)
    C = np.einsum("iajb,a,b->ij", points.covariance().reshape(count, 3, count, 3), up, up)
    centred = np.eye(count) - 1.0 / count
    variance = np.einsum("ij,jk,ik->i", centred, C, centred)
    variance += (scale.tilt_sigma_rad * (along - along.mean())) ** 2
    variance += (scale.sigma * (height - height.mean())) ** 2
    drop = float(height[-1] - height[0])
    of_drop = C[0, 0] + C[-1, -1] - 2.0 * C[0, -1]
    of_drop += (scale.tilt_sigma_rad * length) ** 2 + (scale.sigma * drop) ** 2
    return GroundProfile(
        along, height, np.sqrt(np.maximum(variance, 0.0)),
        Quantity.normal(drop, float(np.sqrt(max(of_drop, 0.0))), scale.unit, -np.inf),
        scale.unit,
    )  # fmt: skip
