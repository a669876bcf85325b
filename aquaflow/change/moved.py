"""Things that moved: a patch that was lost and one that was gained, of one shape and colour."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.change.colour_change import shown_at
from aquaflow.change.comparison import GAINED, LOST, MOVED_AWAY, MOVED_HERE, Comparison
from aquaflow.change.patches import Patch, heights_of, window_of
from aquaflow.change.registration import Registration
from aquaflow.change.relief import Move, Window, best_shift, filled, hull_of
from aquaflow.change.surface import Surface

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

FARTHEST = 6.0
"""Between the two patches' middles, in the diameter of the larger: judgement; what moved further is
told from another thing of its kind by nothing."""
LEAST_LIKENESS = 0.8
"""Correlation of the two shapes above the ground."""
MOST_RATIO = 1.5
"""Of the volumes of the two shapes."""
MOST_COLOUR = 0.35
"""Relative difference of the colours, largest of RGB: two sigmas of restored colours."""


@dataclass(frozen=True)
class _Pair:
    lost: int
    gained: int
    cost: float
    displacement: Array
    sigma: float


def with_moves(
    patches: list[Patch],
    compared: Comparison,
    first: Surface,
    second: Surface,
    registration: Registration,
) -> tuple[list[Patch], Comparison]:
    """The patches with those that are one thing called so; each belongs to one pair at most."""
    pairs = [
        pair
        for a, lost in enumerate(patches)
        for b, gained in enumerate(patches)
        if lost.kind == LOST and gained.kind == GAINED
        for pair in [_matched(a, b, lost, gained, compared, first, second, registration)]
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


def _matched(
    a: int,
    b: int,
    lost: Patch,
    gained: Patch,
    compared: Comparison,
    first: Surface,
    second: Surface,
    registration: Registration,
) -> _Pair | None:
    """The two as one thing; None where they are not."""
    apart = float(np.linalg.norm(lost.place - gained.place))
    if apart > FARTHEST * np.sqrt(max(lost.area, gained.area)):
        return None
    window = window_of(np.concatenate([lost.which, gained.which]), compared)
    before, after = _things(window, lost, gained, compared, first, second)
    volumes = before.sum(), after.sum()
    if min(volumes) <= 0.0 or max(volumes) > MOST_RATIO * min(volumes):
        return None
    move = best_shift(before, after, 1.0)
    if move.likeness < LEAST_LIKENESS or not _same_colour(lost, gained, compared, first, second):
        return None
    across = window.axes[:, :2] @ (move.cells[::-1] * window.cell)
    # The height of the ground below it changes with the place.
    places = compared.places[lost.which].mean(axis=0)
    drift = registration.sigma_along(places[None], window.axes[:, :1].T)[0]
    sigma = float(np.hypot(move.sigma_cells * window.cell, drift))
    return _Pair(a, b, 1.0 - move.likeness + _mismatch(move, volumes), across, sigma)


def _mismatch(move: Move, volumes: tuple[float, float]) -> float:
    """What makes one partner less likely than another: unlike volumes, longer ways."""
    return abs(float(np.log(volumes[0] / volumes[1]))) + 0.01 * float(np.linalg.norm(move.cells))


def _things(
    window: Window,
    lost: Patch,
    gained: Patch,
    compared: Comparison,
    first: Surface,
    second: Surface,
) -> tuple[Array, Array]:
    """[h, w] heights of the thing above the ground on both days; 0 around it.

    Where the patches are neighbours, what lies between them may be covered by the thing on both
    days: the ground there is interpolated.
    """
    before, after = heights_of(window, compared, first), heights_of(window, compared, second)
    masks = [
        window.mask(np.vstack([compared.places[p.which], compared.after[p.which]]))
        for p in (lost, gained)
    ]
    one_place = _gap(masks[0], masks[1]) <= np.sqrt(max(mask.sum() for mask in masks))
    both = hull_of(masks[0] | masks[1]) if one_place else masks[0] | masks[1]
    ground = np.where(both, np.nan, 0.5 * (before + after))
    ground[masks[0]], ground[masks[1]] = after[masks[0]], before[masks[1]]
    ground = filled(ground)
    was, now = (both, both) if one_place else (masks[0], masks[1])
    return (
        np.where(was, np.maximum(before - ground, 0.0), 0.0),
        np.where(now, np.maximum(after - ground, 0.0), 0.0),
    )


def _gap(
    one: Flags,  # [h, w]
    other: Flags,  # [h, w]
) -> float:
    """Cells between two masks, least."""
    places, others = np.argwhere(one), np.argwhere(other)
    away = places[:, None, :] - others[None, :, :]
    return float(np.sqrt((away**2).sum(axis=-1).min()))


def _same_colour(
    lost: Patch, gained: Patch, compared: Comparison, first: Surface, second: Surface
) -> bool:
    """True if what was there looks like what is here now, in the first day's light."""
    radius = compared.scales.cylinder
    was = shown_at(first, compared.places[lost.which], radius).mean
    now = shown_at(second, compared.after[gained.which], radius).mean
    was, now = np.nanmedian(was, axis=0), np.nanmedian(now, axis=0) / compared.colours.gains
    return bool(np.abs(np.log(now / was)).max() <= MOST_COLOUR)
