"""Things that moved: a patch that was lost and one that was gained, of one shape and colour."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from aquaflow.survey.change.colour_change import DARKEST, shown_at
from aquaflow.survey.change.comparison import (
    GAINED,
    LOST,
    MOVED_AWAY,
    MOVED_HERE,
    SurfaceComparison,
)
from aquaflow.survey.change.patches import Patch, heights_of, window_of
from aquaflow.survey.change.registration import Registration
from aquaflow.survey.change.relief import ReliefWindow, best_shift, hull_of
from aquaflow.survey.change.surface import Surface

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

FARTHEST = 6.0
"""Between the two patches' middles, in the root of the larger's area: judgement; what moved further
is told from another thing of its kind by nothing."""
LEAST_LIKENESS = 0.7
"""Mean correlation of heights and brightness: 0.81 of a box that moved 10 cm on the synthetic reef,
0.3 of the same place without a shift."""
MOST_COLOUR = 0.35
"""Natural log of the ratio of the colours, largest of RGB: two sigmas of restored colours."""
NEAREST_POINTS = 8
"""Whose mean brightness a cell has."""


@dataclass(frozen=True)
class _Pair:
    lost: int
    gained: int
    cost: float
    displacement: Array
    sigma: float


def with_moves(
    patches: list[Patch],
    compared: SurfaceComparison,
    first: Surface,
    second: Surface,
    registration: Registration,
) -> tuple[list[Patch], SurfaceComparison]:
    """The patches with those that are one thing called so; each belongs to one pair at most."""
    pairs = [
        pair
        for a, lost in enumerate(patches)
        for b, gained in enumerate(patches)
        if lost.kind == LOST and gained.kind == GAINED
        for pair in [_match_pixels(a, b, lost, gained, compared, first, second, registration)]
        if pair is not None
    ]
    found, kinds, taken = list(patches), compared.kinds.copy(), set[int]()
    for pair in sorted(pairs, key=lambda each: each.cost):
        if taken & {pair.lost, pair.gained}:
            continue
        taken |= {pair.lost, pair.gained}
        x, y, z = pair.displacement.tolist()
        for number, other, kind in (
            (pair.lost, pair.gained, MOVED_AWAY),
            (pair.gained, pair.lost, MOVED_HERE),
        ):
            found[number] = replace(
                found[number], kind=kind, partner=other, displacement=(x, y, z),
                displacement_sigma=pair.sigma,
            )  # fmt: skip
            kinds[found[number].which] = kind
    return found, replace(compared, kinds=kinds)


def _match_pixels(
    a: int,
    b: int,
    lost: Patch,
    gained: Patch,
    compared: SurfaceComparison,
    first: Surface,
    second: Surface,
    registration: Registration,
) -> _Pair | None:
    """The two as one thing; None where they are not."""
    apart = float(np.linalg.norm(lost.place - gained.place))
    size = float(np.sqrt(max(lost.area, gained.area)))
    if apart > FARTHEST * size or not _same_colour(lost, gained, compared, first, second):
        return None
    window = window_of(np.concatenate([lost.which, gained.which]), compared)
    thing = _thing(window, lost, gained, compared)
    before = _layers(window, compared, first, np.ones(3))
    after = _layers(window, compared, second, np.array(compared.colours.gains))
    move = best_shift(before, after, thing, int(np.ceil((apart + size) / window.cell)))
    if move.likeness < LEAST_LIKENESS:
        return None
    across = window.axes[:, :2] @ (move.cells[::-1] * window.cell)
    places = compared.places[lost.which].mean(axis=0)
    drift = registration.sigma_along(places[None], window.axes[:, :1].T)[0]
    sigma = float(np.hypot(move.sigma_cells * window.cell, drift))
    return _Pair(a, b, 1.0 - move.likeness, across, sigma)


def _thing(window: ReliefWindow, lost: Patch, gained: Patch, compared: SurfaceComparison) -> Flags:
    """[h, w] cells that the thing covered on the first day.

    Where the patches are neighbours it covered what lies between them on both days, where no height
    changed: all within the hull of both but what was gained.
    """
    was, now = (
        window.mask(np.vstack([compared.places[p.which], compared.after[p.which]]))
        for p in (lost, gained)
    )
    neighbours = _gap(was, now) <= np.sqrt(max(was.sum(), now.sum()))
    return (hull_of(was | now) & ~now) if neighbours else hull_of(was)


def _layers(
    window: ReliefWindow,
    compared: SurfaceComparison,
    surface: Surface,
    gains: Array,  # [3] that are taken off
) -> Array:
    """[2, h, w] heights, and logarithms of the brightness."""
    heights = heights_of(window, compared, surface)
    _, near = cKDTree(surface.points).query(window.at_height(heights), k=NEAREST_POINTS)
    bright = (surface.colours[near] / gains).mean(axis=(1, 2)).reshape(window.shape)
    return np.stack([heights, np.log(np.maximum(bright, DARKEST))])


def _gap(
    one: Flags,  # [h, w]
    other: Flags,  # [h, w]
) -> float:
    """Cells between two masks, least."""
    places, others = np.argwhere(one), np.argwhere(other)
    away = places[:, None, :] - others[None, :, :]
    return float(np.sqrt((away**2).sum(axis=-1).min()))


def _same_colour(
    lost: Patch, gained: Patch, compared: SurfaceComparison, first: Surface, second: Surface
) -> bool:
    """True if what was there looks like what is here now, in the first day's light."""
    radius = compared.scales.cylinder
    was = shown_at(first, compared.places[lost.which], radius).mean
    now = shown_at(second, compared.after[gained.which], radius).mean
    was, now = np.nanmedian(was, axis=0), np.nanmedian(now, axis=0) / compared.colours.gains
    return bool(np.abs(np.log(now / was)).max() <= MOST_COLOUR)
