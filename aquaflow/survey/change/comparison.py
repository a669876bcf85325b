"""Two surfaces compared place by place: distances, colours, and what of them is significant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from aquaflow.survey.change.colour_change import ColourChange, colour_change, shown_at
from aquaflow.survey.change.m3c2 import DayPoints, Scales, SurfaceDistances, m3c2, normals_at
from aquaflow.survey.change.registration import Registration
from aquaflow.survey.change.significance import discoveries, null_spread, two_sided
from aquaflow.survey.change.surface import Progress, Surface

Array = npt.NDArray[np.float64]
Classes = npt.NDArray[np.int8]

UNCHANGED, GAINED, LOST, BLEACHED, MOVED_AWAY, MOVED_HERE = range(6)
"""Of places that both days show."""
NOT_SEEN = -1
"""Of places that one of the days alone shows."""
NORMAL_RESOLUTIONS = 4.0
"""Radius of the balls that normals come from, in resolutions of the maps: Lague et al. ask for 20
to 25 times the roughness, which is some 3 mm on a map's surface."""
CYLINDER_RESOLUTIONS = 1.5
"""Radius of the cylinders, likewise: 7 places in each that err independently."""
COLOUR_RESOLUTIONS = 4.0
"""Radius of the balls whose mean colours are compared, likewise: within less, what is a few
millimetres off shows as lighter on the one side of a coral and darker on the other."""
REACH_RESOLUTIONS = 18.0
"""Half the cylinders' length, likewise: 0.5 m where a picture shows 1.9 m."""


@dataclass(frozen=True)
class SurfaceComparison:
    """What is known of each core point, a place on the first day's surface."""

    places: Array
    """[N, 3] ground axes of the first dive."""
    area: float
    """Of the surface that each stands for."""
    distances: SurfaceDistances
    """With sigmas that cover the spread of the unchanged."""
    colours: ColourChange
    kinds: Classes
    """[N] UNCHANGED, GAINED, LOST, BLEACHED or NOT_SEEN."""
    null: tuple[float, float]
    """Median of the distances over their stated sigmas, and what these were multiplied by."""
    scales: Scales

    @property
    def after(self) -> Array:
        """[N, 3] the places on the second day's surface; NaN where it was not seen."""
        return self.places + self.distances.distance[:, None] * self.distances.normals

    def chances(self, kind: int) -> Array:
        """[N] probability of a place as far from 0 as it is, of its colour or its distance, where
        nothing changed."""
        if kind == BLEACHED:
            return self.colours.bleach()
        return two_sided(self.distances.distance / self.distances.sigma, self.distances.freedom)


def compare(
    first: Surface,
    second: Surface,
    registration: Registration,
    false_discoveries: float,
    cylinder: float | None,
    reach: float | None,
    progress: Progress,
) -> SurfaceComparison:
    """Compare two surfaces that lie in one frame.

    Args:
        false_discoveries: share of the points that are called changed, which at most did not.
        cylinder: radius of M3C2's cylinders; None: from the maps' resolution.
        reach: half their length; None: likewise.
    """
    resolution = max(first.resolution, second.resolution)
    scales = Scales(
        NORMAL_RESOLUTIONS * resolution, cylinder or CYLINDER_RESOLUTIONS * resolution,
        reach or REACH_RESOLUTIONS * resolution, resolution,
    )  # fmt: skip
    places = thin(first.points, resolution)
    normals = normals_at(places, first.points, first.normals, scales.normal)
    stated = m3c2(
        DayPoints(first.points, first.sigma, first.normals),
        DayPoints(second.points, second.sigma, second.normals),
        places, normals, scales, registration.sigma_along(places, normals), of_surfaces=True,
        progress=partial(progress, "distances"),
    )  # fmt: skip
    middle, wider = null_spread(stated.distance / stated.sigma)
    distances = replace(stated, sigma=wider * stated.sigma)
    there = places + distances.distance[:, None] * normals
    colours = colour_change(
        shown_at(first, places, COLOUR_RESOLUTIONS * resolution),
        shown_at(second, there, COLOUR_RESOLUTIONS * resolution),
    )
    kinds = classes(distances, colours, false_discoveries)
    kinds[is_hidden(first, second, places, there, kinds)] = NOT_SEEN
    return SurfaceComparison(
        places, first.area / max(len(places), 1), distances, colours, kinds, (middle, wider), scales
    )


def is_hidden(
    first: Surface,
    second: Surface,
    places: Array,  # [N, 3]
    there: Array,  # [N, 3] on the second day's surface; NaN: none
    kinds: Classes,  # [N]
) -> npt.NDArray[np.bool_]:
    """[N] True for what would be gained or lost, but the other day's views do not see past it."""
    found = np.zeros(len(places), bool)
    for kind, other, at in ((LOST, second, places), (GAINED, first, there)):
        which = np.flatnonzero(kinds == kind)
        margin = 0.5 * np.linalg.norm(there[which] - places[which], axis=1)
        found[which] = ~other.seen_past(at[which], margin)
    return found


def classes(distances: SurfaceDistances, colours: ColourChange, rate: float) -> Classes:
    """[N] of each place; ``rate``: of false discoveries, of distances and of colours each."""
    kinds = np.full(len(distances.distance), NOT_SEEN, np.int8)
    kinds[distances.seen] = UNCHANGED
    bleached = np.where(distances.seen, colours.bleach(), np.nan)
    kinds[discoveries(bleached, rate)] = BLEACHED
    # What stands there now is another surface, whatever its colour.
    chance = two_sided(distances.distance / distances.sigma, distances.freedom)
    changed = discoveries(chance, rate)
    kinds[changed & (distances.distance > 0.0)] = GAINED
    kinds[changed & (distances.distance < 0.0)] = LOST
    return kinds


def thin(
    points: Array,  # [N, 3]
    side: float,
) -> Array:
    """[M, 3] one of the points in each cube of space, the one nearest to the cube's middle."""
    cubes = np.floor(points / side).astype(np.int64)
    away = ((points - (cubes + 0.5) * side) ** 2).sum(axis=1)
    order = np.argsort(away, kind="stable")
    _, chosen = np.unique(cubes[order], axis=0, return_index=True)
    return np.asarray(points[np.sort(order[chosen])])
