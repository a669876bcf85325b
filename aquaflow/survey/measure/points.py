"""Points that were marked on a map, and how well each is known against the others.

A point errs in two ways. Its own error is that of marking it. The shared error is the map's: the
same views, with the same errors of their poses and ranges, made the ground around it, so that
neighbours err nearly alike and the length between them by little. Between points d apart the
shared errors have the correlation exp(-d / reach) (an exponential covariance, Rasmussen and
Williams, Gaussian Processes for Machine Learning, eq. 4.18, with nu = 1/2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError

Array = npt.NDArray[np.float64]

MOST_POINTS = 1000
"""In one measurement: the covariance of all takes 72 MB."""


@dataclass(frozen=True)
class MeasuredPoints:
    """Places in one frame of reference: n, as map.ply and notes have it, or the ground's."""

    places: Array
    """[N, 3] in the unit of the dive's lengths."""
    own: Array
    """[N, 3, 3] covariance of what each point errs alone."""
    shared: Array
    """[N, 3, 3] covariance of what it errs together with its neighbours."""
    reach: float
    """Distance at which the correlation of shared errors is 1/e: what a picture shows, about."""

    def __post_init__(self) -> None:
        """Refuse what is no point.

        Raises:
            InputError: there are too many points, or a number is not finite.
        """
        if len(self.places) > MOST_POINTS:
            raise InputError(
                f"{len(self.places)} points are too many for one measurement; give up to "
                f"{MOST_POINTS}"
            )
        arrays = (self.places, self.own, self.shared)
        if not all(np.isfinite(each).all() for each in arrays) or not self.reach > 0.0:
            raise InputError("a point to measure is not finite; mark it again")

    @staticmethod
    def round(
        places: Array,  # [N, 3]
        own_sigma: Array,  # [N] 1 sigma along each axis
        shared_sigma: Array,  # [N] the same of the shared error
        reach: float,
    ) -> MeasuredPoints:
        """Points whose errors are as large in all directions."""
        own, shared = (
            np.asarray(sigma, np.float64)[:, None, None] ** 2 * np.eye(3)
            for sigma in (own_sigma, shared_sigma)
        )
        return MeasuredPoints(np.asarray(places, np.float64), own, shared, reach)

    def covariance(self) -> Array:
        """[3 N, 3 N] of all coordinates, point by point."""
        count = len(self.places)
        apart = np.linalg.norm(self.places[:, None] - self.places[None], axis=-1)
        root = _square_roots(self.shared)
        together = np.einsum("ij,iab,jcb->iajc", np.exp(-apart / self.reach), root, root)
        index = np.arange(count)
        together[index, :, index, :] += self.own
        return np.asarray(together.reshape(3 * count, 3 * count))


def _square_roots(
    covariances: Array,  # [N, 3, 3]
) -> Array:
    """[N, 3, 3] symmetric S with S S = the covariance; also of one that is singular."""
    values, vectors = np.linalg.eigh(covariances)
    roots = np.sqrt(np.maximum(values, 0.0))
    return np.asarray(np.einsum("nij,nj,nkj->nik", vectors, roots, vectors))
