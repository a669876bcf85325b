"""Lengths and areas between marked points, each with its uncertainty.

Sigmas are of first order in the errors of the points, J C J^T, and of the scale. What the errors
across a length add to it, sqrt(d^2 + sigma^2) - d, is of second order and always lengthens; it is
taken into sigma, so that lengths of a few sigma are not called exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.geometry.similarity import hat
from aquaflow.survey.measure.points import MeasuredPoints
from aquaflow.survey.measure.quantity import NORMAL_95, Quantity, Scale

Array = npt.NDArray[np.float64]

LEAST_CORNERS = 3
"""Of an area."""


def distance(points: MeasuredPoints, scale: Scale) -> Quantity:
    """The straight length between two points.

    Raises:
        InputError: there are not two points.
    """
    if len(points.places) != 2:
        raise InputError(f"a distance has 2 points, not {len(points.places)}; mark both ends")
    return path_length(points, scale)


def path_length(points: MeasuredPoints, scale: Scale) -> Quantity:
    """The length of the line from point to point.

    Raises:
        InputError: there are fewer than two points.
    """
    count = len(points.places)
    if count < 2:
        raise InputError("a length needs 2 points at least; mark another one")
    steps = np.diff(points.places, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    C = points.covariance().reshape(count, 3, count, 3)
    directions, bias = np.zeros((count - 1, 3)), 0.0
    for k, (step, length) in enumerate(zip(steps, lengths, strict=True)):
        of_step = C[k, :, k] + C[k + 1, :, k + 1] - C[k, :, k + 1] - C[k + 1, :, k]
        directions[k] = step / length if length > 0.0 else np.linalg.eigh(of_step)[1][:, -1]
        bias += _lengthen(float(length), of_step, directions[k])
    J = np.zeros((count, 3))
    J[:-1] -= directions
    J[1:] += directions
    return _with_scale(float(lengths.sum()), J, points, bias, scale, 1)


def area(points: MeasuredPoints, scale: Scale) -> Quantity:
    """What an outline encloses, in the plane that fits it best; exact for a triangle.

    It is the length of the vector area, half the sum of the products p_i x p_i+1: of a curved
    outline the largest of its projections. The relief inside does not count.

    Raises:
        InputError: there are fewer than three points, or the outline crosses itself.
    """
    normal = _vector_area(points)
    size = float(np.linalg.norm(normal))
    C = points.covariance()
    across = np.concatenate([-0.5 * hat(chord) for chord in _chords(points.places)], axis=1)
    C_area = across @ C @ across.T
    up = normal / size if size > 0.0 else np.linalg.eigh(C_area)[1][:, -1]
    _refuse_crossing(points.places, up)
    J = 0.5 * np.cross(_chords(points.places), up)
    return _with_scale(size, J, points, _lengthen(size, C_area, up), scale, 2)


def plan_area(
    points: MeasuredPoints,
    up: Array,  # [3] unit, in the points' frame
    scale: Scale,
) -> Quantity:
    """What an outline encloses on a chart: its projection along the vertical.

    Raises:
        InputError: there are fewer than three points, or the outline crosses itself.
    """
    signed = float(_vector_area(points) @ up)
    _refuse_crossing(points.places, up)
    J = 0.5 * np.cross(_chords(points.places), up)
    return _with_scale(abs(signed), J, points, 0.0, scale, 2)


def _with_scale(
    value: float,
    J: Array,  # [N, 3]
    points: MeasuredPoints,
    bias: float,
    scale: Scale,
    dimensions: int,
) -> Quantity:
    """``dimensions`` 1: a length; 2: an area, which a scale changes twice as much."""
    gradient = J.ravel()
    variance = float(gradient @ points.covariance() @ gradient)
    variance += bias**2 + (dimensions * scale.sigma * value) ** 2
    unit = scale.unit if dimensions == 1 else scale.square_unit
    return Quantity.normal(value, float(np.sqrt(max(variance, 0.0))), unit)


def _lengthen(
    length: float,
    covariance: Array,  # [3, 3]
    direction: Array,  # [3] unit
) -> float:
    """By how much errors across a vector lengthen it, in the root mean square."""
    across = max(float(np.trace(covariance) - direction @ covariance @ direction), 0.0)
    return float(np.sqrt(length**2 + across) - length)


def _vector_area(points: MeasuredPoints) -> Array:
    """[3] half the sum of the corners' products; its length is the area.

    Raises:
        InputError: there are fewer than three points.
    """
    if len(points.places) < LEAST_CORNERS:
        raise InputError(f"an area needs {LEAST_CORNERS} points at least; mark another one")
    local = points.places - points.places.mean(axis=0)
    return np.asarray(0.5 * np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0))


def _chords(
    places: Array,  # [N, 3]
) -> Array:
    """[N, 3] from each corner's last neighbour to its next."""
    return np.roll(places, -1, axis=0) - np.roll(places, 1, axis=0)


def _refuse_crossing(
    places: Array,  # [N, 3]
    up: Array,  # [3] unit
) -> None:
    """Raises InputError where two sides cross, seen along ``up``."""
    basis = np.linalg.svd(up[None])[2][1:]
    corners = (places - places.mean(axis=0)) @ basis.T
    ends = np.roll(corners, -1, axis=0)

    def side(
        point: Array,  # [M, 2]
    ) -> Array:  # [N, M] which side of each line a point lies on
        along, to = (ends - corners)[:, None], point[None] - corners[:, None]
        return np.asarray(np.sign(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0]))

    parted = side(corners) * side(ends) < 0.0
    if bool((parted & parted.T).any()):
        raise InputError("the outline crosses itself; mark its corners in their order")


# --------------------------------------------------------------------------------------------------
# Heights along a straight line.


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
