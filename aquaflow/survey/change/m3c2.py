"""M3C2: signed distances between two clouds of points along the local normal of the first.

D. Lague, N. Brodu, J. Leroux, "Accurate 3D comparison of complex topography with terrestrial laser
scanner: Application to the Rangitikei canyon (N-Z)", ISPRS Journal 82 (2013): the normal of a core
point is that of a plane through the first cloud around it, at one scale; a cylinder along it cuts
both clouds, and the distance is that between the means, or the medians, of both along the axis.

The level of detection at 95 % is 1.96 sigma, of an effective number of points below 30 Student's t
in its place (Welch and Satterthwaite's degrees of freedom). Points of a map are not independent as
those of a scanner are: the caller says how far apart two points have to be, and the variance that a
cylinder's points share is added as it is, not divided by their number. Registration is a third
part. The three are added as variances (L. Winiwarter et al., "M3C2-EP", ISPRS Journal 178 (2021));
Lague et al. add that of the registration linearly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.stats import t as student

from aquaflow.optimise.robust import MAD_TO_SIGMA

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Progress = Callable[[int, int], None]

CONFIDENCE = 0.95
"""Of the level of detection, two-sided, as in the paper."""
LEAST_POINTS = 5
"""Of either cloud in a cylinder, or the place was not seen there: a standard deviation of fewer
says little. The paper asks for 4, and for 20 to 30 where there are as many."""
LEAST_FACING = 0.3
"""Cosine between a point's normal and a core point's: 73 degrees, so that a face at right angles is
another one, and the slopes of a rough ground are not."""


@dataclass(frozen=True)
class DayPoints:
    """Points of one day."""

    points: Array
    """[N, 3]"""
    sigma: Array
    """[N] 1 sigma of a point, shared with its neighbours, same unit."""
    normals: Array | None = None
    """[N, 3] unit; with them, only what faces as a core point does counts for it."""


@dataclass(frozen=True)
class Scales:
    """Lengths, in the unit of the clouds."""

    normal: float
    """Radius of the ball whose points of the first cloud give the normal."""
    cylinder: float
    """Radius of the cylinder."""
    reach: float
    """Half its length: larger changes are not found."""
    apart: float
    """Distance of points from which they err independently."""


@dataclass(frozen=True)
class SurfaceDistances:
    """Distances of each core point; NaN where a cloud has too few points in the cylinder."""

    distance: Array
    """[N] along the normal, positive where the second cloud lies towards it."""
    sigma: Array
    """[N] 1 sigma of it."""
    freedom: Array
    """[N] degrees of freedom of sigma."""
    normals: Array
    """[N, 3] unit."""
    first: Integers
    second: Integers
    """[N] points of each cloud in the cylinder."""

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """[N] True where both clouds have a surface."""
        return np.isfinite(self.distance)

    def level(self) -> Array:
        """[N] level of detection: what |distance| stays below with this probability where nothing
        changed."""
        return np.asarray(student.ppf(0.5 + 0.5 * CONFIDENCE, self.freedom) * self.sigma)


def normals_at(
    cores: Array,  # [N, 3]
    points: Array,  # [M, 3]
    towards: Array,  # [M, 3] directions, of each point, of the side that is outside
    radius: float,
) -> Array:
    """[N, 3] unit normals of planes through the points within ``radius`` of each core point; NaN
    where there are fewer than three."""
    tree, found = cKDTree(points), np.full((len(cores), 3), np.nan)
    for part in parts(len(cores)):
        owner, neighbour = pairs_within(tree, cores[part], radius)
        number = np.bincount(owner, minlength=part.stop - part.start)
        offset = points[neighbour] - cores[part][owner]
        centred = offset - means_by(owner, offset, number)[owner]
        products = (centred[:, :, None] * centred[:, None, :]).reshape(-1, 9)
        spread = means_by(owner, products, number).reshape(-1, 3, 3)
        normal = np.linalg.eigh(spread)[1][:, :, 0]
        outside = means_by(owner, towards[neighbour], number)
        side = np.where((normal * outside).sum(axis=1) < 0.0, -1.0, 1.0)
        found[part] = np.where((number >= 3)[:, None], side[:, None] * normal, np.nan)
    return found


def m3c2(
    first: DayPoints,
    second: DayPoints,
    cores: Array,  # [N, 3]
    normals: Array,  # [N, 3] unit; NaN: none
    scales: Scales,
    registration: Array | None = None,  # [N] 1 sigma along the normals
    of_surfaces: bool = False,
    progress: Progress | None = None,
) -> SurfaceDistances:
    """Distances from ``first`` to ``second`` at ``cores``.

    Args:
        registration: of how well the clouds are aligned; None: exactly.
        of_surfaces: for clouds that several layers of a surface make (a coral's two sides, what is
            below an overhang): of each cloud the layer that is nearest to the core point alone, so
            that what is still there counts as there; medians and their median absolute deviations
            in place of means and standard deviations.
        progress: called with (core points done, core points in all).
    """
    sides = [
        _along(cloud, cores, normals, scales, of_surfaces, progress) for cloud in (first, second)
    ]
    a, b = sides
    seen = (a.count >= LEAST_POINTS) & (b.count >= LEAST_POINTS)
    shared = a.shared**2 + b.shared**2
    if registration is not None:
        shared = shared + registration**2
    own = [side.spread**2 / side.effective for side in sides]
    total = own[0] + own[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        less = sum(
            v**2 / np.maximum(s.effective - 1.0, 1.0) for v, s in zip(own, sides, strict=True)
        )
        freedom = np.where(less > 0.0, (total + shared) ** 2 / less, np.inf)
    distance = np.where(seen, b.middle - a.middle, np.nan)
    sigma = np.where(seen, np.sqrt(total + shared), np.nan)
    return SurfaceDistances(distance, sigma, freedom, normals, a.count, b.count)


@dataclass(frozen=True)
class _Side:
    """One cloud in the cylinders."""

    middle: Array
    spread: Array
    """[N] along the axis."""
    shared: Array
    """[N] mean sigma of the points."""
    count: Integers
    effective: Array
    """[N] of points that err independently, at least 1."""


def _along(
    cloud: DayPoints,
    cores: Array,  # [N, 3]
    normals: Array,  # [N, 3]
    scales: Scales,
    of_surfaces: bool,
    progress: Progress | None,
) -> _Side:
    tree, total = cKDTree(cloud.points), len(cores)
    middle, spread, shared = (np.full(total, np.nan) for _ in range(3))
    count = np.zeros(total, np.int64)
    usable = np.flatnonzero(np.isfinite(normals).all(axis=1))
    # Balls strung along the axis hold the cylinder; each answers for the disc around its middle.
    half = scales.cylinder
    steps = 2 * math.ceil(scales.reach / (2.0 * half)) + 1
    stops = np.asarray(2.0 * half * (np.arange(steps) - steps // 2), np.float64)
    ball = math.sqrt(2.0) * half * (1.0 + 1e-9)
    for part in parts(len(usable), max(1, CENTRES_AT_ONCE // steps)):
        which = usable[part]
        centres = cores[which, None] + stops[:, None] * normals[which, None]
        near, neighbour = pairs_within(tree, centres.reshape(-1, 3), ball)
        number = near // steps
        offset = cloud.points[neighbour] - cores[which][number]
        axes = normals[which][number]
        along, inside = _in_cylinder(offset, axes, stops[near % steps], scales)
        if cloud.normals is not None:
            inside &= (cloud.normals[neighbour] * axes).sum(axis=1) >= LEAST_FACING
        if of_surfaces:
            inside &= _nearest_layer(number, along, inside, len(which), 2.0 * half)
        owner, values = number[inside], along[inside]
        found = np.bincount(owner, minlength=len(which))
        count[which] = found
        middle[which], spread[which] = _centre(owner, values, found, of_surfaces)
        sigma = cloud.sigma[neighbour[inside]]
        shared[which] = means_by(owner, sigma[:, None], found)[:, 0]
        if progress is not None:
            progress(int(which[-1]) + 1, total)
    most = max(1.0, np.pi * scales.cylinder**2 / scales.apart**2)
    return _Side(middle, spread, shared, count, np.clip(count, 1.0, most))


def _in_cylinder(
    offset: Array,  # [K, 3] of points from their core point
    axis: Array,  # [K, 3] unit
    stop: Array,  # [K] along the axis, of the middle of the ball that found the point
    scales: Scales,
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """[K] places along the axis, and whether the cylinder holds them within the ball's own disc."""
    along = (offset * axis).sum(axis=1)
    across = (offset**2).sum(axis=1) - along**2
    inside = (across <= scales.cylinder**2) & (np.abs(along) <= scales.reach)
    own = (along >= stop - scales.cylinder) & (along < stop + scales.cylinder)
    return along, inside & own


def _nearest_layer(
    owner: Integers,  # [K]
    along: Array,  # [K]
    inside: npt.NDArray[np.bool_],  # [K]
    count: int,
    depth: float,
) -> npt.NDArray[np.bool_]:
    """[K] True for what lies within ``depth`` beyond the owner's point that is nearest to it."""
    nearest = np.full(count, np.inf)
    np.minimum.at(nearest, owner[inside], np.abs(along[inside]))
    return np.asarray(np.abs(along) <= nearest[owner] + depth)


def _centre(
    owner: Integers,  # [K] ascending
    along: Array,  # [K]
    number: Integers,  # [n] of each owner
    robust: bool,
) -> tuple[Array, Array]:
    """[n] middles and [n] spreads of each owner's values."""
    if not robust:
        mean = means_by(owner, along[:, None], number)[:, 0]
        squares = np.bincount(owner, (along - mean[owner]) ** 2, minlength=len(number))
        return mean, np.sqrt(squares / np.maximum(number - 1, 1))
    middle = _medians(owner, along, number)
    return middle, MAD_TO_SIGMA * _medians(owner, np.abs(along - middle[owner]), number)


def _medians(
    owner: Integers,  # [K]
    values: Array,  # [K]
    number: Integers,  # [n]
) -> Array:
    """[n] medians; NaN of none."""
    found = np.full(len(number), np.nan)
    some = number > 0
    if not some.any():
        return found
    ordered = values[np.lexsort((values, owner))]
    start = (np.cumsum(number) - number)[some]
    low, high = start + (number[some] - 1) // 2, start + number[some] // 2
    found[some] = 0.5 * (ordered[low] + ordered[high])
    return found


# --------------------------------------------------------------------------------------------------
# Pairs of places and the points around them, and what each place makes of its own.

CENTRES_AT_ONCE = 4096
"""Balls in which neighbours are looked for at a time; some 100 MB with 500 points in each."""


def parts(count: int, size: int = CENTRES_AT_ONCE) -> Iterator[slice]:
    """Parts of ``count`` places."""
    for first in range(0, count, size):
        yield slice(first, min(count, first + size))


def pairs_within(
    tree: cKDTree,
    centres: Array,  # [N, 3] finite
    radius: float,
) -> tuple[Integers, Integers]:
    """Numbers of centres [K] and of the tree's points [K] within ``radius`` of them."""
    found = cKDTree(centres).sparse_distance_matrix(tree, radius, output_type="ndarray")
    return found["i"].astype(np.int64), found["j"].astype(np.int64)


def means_by(
    owner: Integers,  # [K]
    values: Array,  # [K, C]
    number: Integers,  # [n] of values of each owner
) -> Array:
    """[n, C] means of each owner's values; 0 of none."""
    sums = [np.bincount(owner, column, minlength=len(number)) for column in values.T]
    return np.asarray(np.stack(sums, axis=1) / np.maximum(number, 1)[:, None])
