"""Least-squares alignment of two point lists by a rigid motion or a similarity.

Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point
patterns", IEEE PAMI 13(4), 1991. Numbers in brackets below are the paper's equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.geometry.similarity import Sim3

if TYPE_CHECKING:
    pass

MINIMUM_POINTS = 3
"""Three points are the fewest that fix a rotation."""

POINT_SPREAD = 1e-9
"""Points are one point if their spread is below this fraction of their distance from the origin."""

LINE_SPREAD = 1e-3
"""Points lie on a line if their second standard deviation is below this fraction of the first.

At 1e-3 an error of a millimetre across a line of a metre turns the pose by 45 degrees about it."""


@dataclass(frozen=True)
class Alignment:
    """What maps the source's points onto the target's, and how far it can be trusted."""

    T_target_source: Sim3
    collinear: bool
    """True if the points lie on a line: then the turn about that line is arbitrary."""


def align(
    source: npt.NDArray[np.floating],  # [N, 3]
    target: npt.NDArray[np.floating],  # [N, 3]
    *,
    with_scale: bool,
) -> Alignment:
    """The similarity (``with_scale``) or rigid motion that maps ``source`` onto ``target`` best.

    Points on a line are aligned too: positions come out right, the turn about the line is
    arbitrary, and :attr:`Alignment.collinear` is True.

    Raises:
        InputError: fewer than three points, a point that is not finite, or all points in one place.
    """
    x, y = _check(source, target)

    # Means and variances (34)-(37).
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    dx, dy = x - mean_x, y - mean_y
    variance_x = float((dx**2).sum(axis=1).mean())

    # Covariance and its singular values (38), (39). Numpy returns V transposed.
    covariance = dy.T @ dx / len(x)
    U, D, Vt = np.linalg.svd(covariance)

    # The sign that keeps R a rotation (39), (43); with rank 2 it also fixes the normal's sign.
    S = np.eye(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0.0:
        S[2, 2] = -1.0

    # Rotation (40), scale (42), translation (41).
    R = U @ S @ Vt
    scale = float((D * np.diag(S)).sum() / variance_x) if with_scale else 1.0
    t = mean_y - scale * R @ mean_x
    return Alignment(Sim3(R, t, scale), collinear=_on_a_line(dx) or _on_a_line(dy))


def _check(
    source: npt.NDArray[np.floating],  # [N, 3]
    target: npt.NDArray[np.floating],  # [N, 3]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Both lists as float64 [N, 3], or the sentence that says why they cannot be aligned."""
    x = np.asarray(source, dtype=np.float64)
    y = np.asarray(target, dtype=np.float64)
    if x.shape != y.shape or x.ndim != 2 or x.shape[1] != 3:
        raise InputError(
            f"cannot align positions of shapes {x.shape} and {y.shape}; both must be [N, 3]"
        )
    if len(x) < MINIMUM_POINTS:
        raise InputError(
            f"cannot align {len(x)} common position(s); at least {MINIMUM_POINTS} frames must be "
            "posed in both the estimate and the truth"
        )
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError("cannot align positions that are not finite; remove them from the file")
    for points, name in ((x, "estimated"), (y, "true")):
        spread = np.linalg.norm(points - points.mean(axis=0), axis=1).max()
        if spread <= POINT_SPREAD * np.linalg.norm(points, axis=1).max():
            raise InputError(
                f"cannot align: all {len(points)} {name} positions are the same point; "
                "a camera that does not move has no trajectory to compare"
            )
    return x, y


def _on_a_line(
    centred: npt.NDArray[np.float64],  # [N, 3]
) -> bool:
    """True if centred points [N, 3] spread in one direction only."""
    spread = np.linalg.svd(centred, compute_uv=False)
    return bool(spread[1] <= LINE_SPREAD * spread[0])
