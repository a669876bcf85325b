"""How far matches lie from each other's epipolar lines under a relative pose."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3, hat

Array = npt.NDArray[np.float64]

LEAST_GRADIENT = 1e-12
"""Of the constraint; a match at the epipole satisfies every pose."""


def epipolar_distances(
    rays_a: Array,  # [M, 3] z = 1
    rays_b: Array,  # [M, 3] z = 1
    T_ba: Sim3,
) -> Array:
    """[M] Sampson distances, in units of the normalised plane.

    To first order the least move of both points that meets the constraint (P. D. Sampson, "Fitting
    conic sections to very scattered data", 1982). Neither depths nor the scale of ``T_ba`` matter.
    """
    t = T_ba.t / max(float(np.linalg.norm(T_ba.t)), LEAST_GRADIENT)
    E = hat(t) @ T_ba.R
    lines_b, lines_a = rays_a @ E.T, rays_b @ E
    constraint = (rays_b * lines_b).sum(axis=1)
    gradient = np.hypot(
        np.linalg.norm(lines_a[:, :2], axis=1), np.linalg.norm(lines_b[:, :2], axis=1)
    )
    return np.asarray(np.abs(constraint) / np.maximum(gradient, LEAST_GRADIENT))
