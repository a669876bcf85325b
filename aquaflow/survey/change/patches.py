"""Places that changed alike, side by side, as patches: where, how large, how much, how sure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from aquaflow.survey.change.comparison import (
    BLEACHED,
    COLOUR_RESOLUTIONS,
    GAINED,
    LOST,
    MOVED_AWAY,
    MOVED_HERE,
    UNCHANGED,
    SurfaceComparison,
)
from aquaflow.survey.change.m3c2 import pairs_within
from aquaflow.survey.change.relief import ReliefWindow, fill
from aquaflow.survey.change.surface import Surface

Array = npt.NDArray[np.float64]

TOUCHING = 1.8
"""Distance of core points, in their spacing, up to which they are neighbours: sqrt(3) for those of
cubes that meet in a corner."""
NAMES = {
    GAINED: "gained", LOST: "lost", BLEACHED: "bleached",
    MOVED_AWAY: "moved away", MOVED_HERE: "moved here",
}  # fmt: skip
LEAST_CYLINDERS = 2.0
"""Area of a patch in cross-sections of a cylinder (of a colour's ball), at least: what one cylinder
errs in, the core points within it err in together, and so a patch of one cross-section at most."""


@dataclass(frozen=True)
class Patch:
    """Neighbouring places that changed alike."""

    kind: int
    which: npt.NDArray[np.intp]
    """[M] numbers of the core points."""
    place: Array
    """[3] middle of its points on the first day's surface, ground axes."""
    area: float
    volume: float
    """Between the two surfaces, positive where there is more now; NaN of a bleached one."""
    volume_sigma: float
    distance: float
    """Mean over its points."""
    distance_sigma: float
    lighter: float
    """Median, natural log of the brightness over the first day's."""
    purer: float
    """Median, saturation less the first day's."""
    chance: float
    """Largest probability of one of its points where nothing changed."""
    partner: int | None = None
    """Of a thing that moved: number of the patch where it was, or is now."""
    displacement: tuple[float, float, float] | None = None
    displacement_sigma: float | None = None
    """Of each of its components."""


def find_patches(
    compared: SurfaceComparison,
    first: Surface,
    second: Surface,
) -> tuple[list[Patch], SurfaceComparison]:
    """The patches that are large enough, the largest first, and the comparison without others."""
    found, kinds = [], np.where(compared.kinds > UNCHANGED, UNCHANGED, compared.kinds)
    for kind in (GAINED, LOST, BLEACHED):
        radius = compared.scales.cylinder
        if kind == BLEACHED:
            radius = COLOUR_RESOLUTIONS * compared.scales.apart
        least = LEAST_CYLINDERS * np.pi * radius**2
        for which in connect(compared.places, compared.kinds == kind, compared.scales.apart):
            if len(which) * compared.area >= least:
                found.append(_patch(kind, which, compared, first, second))
                kinds[which] = kind
    found.sort(key=lambda patch: -patch.area)
    return found, replace(compared, kinds=kinds.astype(np.int8))


def connect(
    places: Array,  # [N, 3]
    chosen: npt.NDArray[np.bool_],  # [N]
    spacing: float,
) -> list[npt.NDArray[np.intp]]:
    """Numbers of the chosen places, group by group of neighbours."""
    which = np.flatnonzero(chosen)
    if len(which) == 0:
        return []
    pairs = pairs_within(cKDTree(places[which]), places[which], TOUCHING * spacing)
    shape = (len(which), len(which))
    graph = coo_array((np.ones(len(pairs[0]), np.int8), pairs), shape=shape)
    count, group = connected_components(graph, directed=False)
    return [which[group == number] for number in range(count)]


def _patch(
    kind: int,
    which: npt.NDArray[np.intp],  # [M]
    compared: SurfaceComparison,
    first: Surface,
    second: Surface,
) -> Patch:
    distances = compared.distances
    area = float(len(which) * compared.area)
    # Neighbours share the larger part of their errors.
    sigma = float(np.sqrt(np.mean(distances.sigma[which] ** 2)))
    volume = np.nan if kind == BLEACHED else _volume(which, compared, first, second)
    return Patch(
        kind, which, np.median(compared.places[which], axis=0), area, volume, sigma * area,
        float(np.mean(distances.distance[which])), sigma,
        float(np.nanmedian(compared.colours.lighter[which])),
        float(np.nanmedian(compared.colours.purer[which])),
        float(np.max(compared.chances(kind)[which])),
    )  # fmt: skip


def _volume(
    which: npt.NDArray[np.intp],  # [M]
    compared: SurfaceComparison,
    first: Surface,
    second: Surface,
) -> float:
    """Between the upper sides of both days over the patch, across the plane of its surroundings."""
    window = window_of(which, compared)
    mask = window.mask(np.vstack([compared.places[which], compared.after[which]]))
    # At a thing's rim a cylinder still holds ground of both days, and so it is not in the patch.
    rim = int(np.ceil(compared.scales.cylinder / window.cell))
    mask = binary_dilation(mask, iterations=rim)
    before, after = heights_of(window, compared, first), heights_of(window, compared, second)
    return float((after - before)[mask].sum() * window.cell**2)


def window_of(
    which: npt.NDArray[np.intp],  # [M]
    compared: SurfaceComparison,
) -> ReliefWindow:
    """The raster over some core points, in the plane of what is unchanged around them."""
    places = np.vstack([compared.places[which], compared.after[which]])
    middle = places.mean(axis=0)
    around = 2.0 * float(np.linalg.norm(places - middle, axis=1).max())
    around += compared.scales.normal
    near = np.linalg.norm(compared.places - middle, axis=1) < around
    same = near & (compared.kinds == UNCHANGED) & np.isfinite(compared.distances.normals[:, 0])
    normals = compared.distances.normals[same if same.any() else which]
    return ReliefWindow.around(places, normals.mean(axis=0), compared.scales.apart)


def heights_of(window: ReliefWindow, compared: SurfaceComparison, surface: Surface) -> Array:
    """[h, w] upper side of a surface over a window, with holes interpolated."""
    level = float(((compared.places - window.origin) @ window.axes[:, 2]).mean())
    reach = 4.0 * compared.scales.reach
    return fill(window.heights(surface.points, (level - reach, level + reach)))
