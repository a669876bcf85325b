"""Normals of the surface where it was sighted, by which it faces a lamp or turns away."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from aquaflow.water.observations import Observations
from aquaflow.water.sightings import PosedPicture

Array = npt.NDArray[np.float64]

SURFACE, NEIGHBOURS, ROUNDS = 20_000, 240, 4
"""Places that normals are fitted to, those nearest to a patch, and how often the plane through them
is fitted anew. Half to an eighth of them on ten rendered dives with lamps: the noise of the map's
ranges hides how patches face a lamp, and the stated deviations are too small."""
PLACES_AT_ONCE = 50
"""Between two pauses: their planes take 5 ms."""
TINY = 1e-9
"""Guards a division where the surface is flat."""


def with_normals(
    seen: Observations,  # of the surface
    pictures: Sequence[PosedPicture],  # by the number of the view
) -> Generator[None, None, Observations]:
    """The observations with the normals of their places that face the cameras; with pauses."""
    if seen.ray is None:
        return seen
    normals = yield from _normals(pictures, seen.positions, np.random.default_rng(0))
    R_wc = np.stack([picture.T_wc.R for picture in pictures])
    normal = np.einsum("mi,mij->mj", normals[seen.point], R_wc[seen.view])
    normal *= -np.sign((seen.ray * normal).sum(axis=1, keepdims=True))
    return replace(seen, normal=normal)


def _normals(
    pictures: Sequence[PosedPicture],
    places: Array,  # [P, 3] world
    random: np.random.Generator,
) -> Generator[None, None, Array]:
    """[P, 3] unit, world: of the planes that fit the surface around best, what stands out left
    out; with pauses."""
    each = -(-SURFACE // max(len(pictures), 1))
    surface = np.concatenate(
        [np.zeros((0, 3)), *(picture.random_surface(each, random) for picture in pictures)]
    )
    yield
    surface = surface[np.isfinite(surface).all(axis=1)]
    normals, count = np.zeros_like(places), min(NEIGHBOURS, len(surface))
    if count == 0:
        return normals
    tree = KDTree(surface)
    yield
    for first in range(0, len(places), PLACES_AT_ONCE):
        some = slice(first, first + PLACES_AT_ONCE)
        around = surface[tree.query(places[some], count)[1].reshape(-1, count)]
        share = np.full(around.shape[:2], 1.0 / count)
        for _ in range(ROUNDS):
            off = around - np.einsum("nk,nki->ni", share, around)[:, None]
            scatter = np.einsum("nk,nki,nkj->nij", share, off, off)
            normals[some] = np.linalg.eigh(scatter)[1][:, :, 0]
            away = np.abs(np.einsum("nki,ni->nk", off, normals[some]))
            usual = 1.5 * np.median(away, axis=1, keepdims=True) + TINY
            share = 1.0 / (1.0 + (away / usual) ** 2)
            share /= share.sum(axis=1, keepdims=True)
        yield
    return normals
