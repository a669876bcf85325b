"""Cost and normal equations by the pixel residual in compiled code (native/pose_equations.h)."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3
from aquaflow.render.library import Library
from aquaflow.tracking.pose.residuals import (
    BEHIND,
    INLIER,
    MAX_DEPTH_CHANGE,
    Matches,
    nearest_depth,
)

Array = npt.NDArray[np.float64]

_COLUMNS = ("X", "Y", "Z", "variance", "u", "v", "weights", "nearer")


class _Equations(ctypes.Structure):
    """``PoseEquations`` of native/pose_equations.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in _COLUMNS),
        ("count", ctypes.c_int32),
        *((name, ctypes.c_double) for name in ("fx", "fy", "cx", "cy", "sigma_px")),
        ("R", ctypes.c_double * 9),
        ("t", ctypes.c_double * 3),
        ("scale", ctypes.c_double),
        *(
            (name, ctypes.c_double)
            for name in ("nearest", "huber", "behind", "most_change", "inlier")
        ),
    )


class _Result(ctypes.Structure):
    """``PoseResult`` of the same file."""

    _fields_ = (
        ("H", ctypes.c_double * 36),
        ("g", ctypes.c_double * 6),
        ("cost", ctypes.c_double),
    )


class _Left(ctypes.Structure):
    """``PoseLeft`` of the same file."""

    _fields_ = (("residual", ctypes.c_void_p), ("pull", ctypes.c_void_p))


class PixelEquations:
    """The compiled equations of some matches, at one pose after the other."""

    def __init__(self, library: Library, matches: Matches, huber: float) -> None:
        self._library, self._matches = library, matches
        self._columns = [
            None if each is None else np.ascontiguousarray(each, np.float64)
            for each in (
                *matches.X, matches.variance, matches.u, matches.v, matches.weights, matches.nearer
            )
        ]  # fmt: skip
        addresses = [None if each is None else each.ctypes.data for each in self._columns]
        limits = {"behind": BEHIND, "most_change": MAX_DEPTH_CHANGE, "inlier": INLIER}
        columns = dict(zip(_COLUMNS, addresses, strict=True))
        self._given = given = _Equations(**columns, **limits)
        camera = matches.camera
        given.fx, given.fy, given.cx, given.cy = camera.fx, camera.fy, camera.cx, camera.cy
        given.count, given.sigma_px, given.huber = len(matches), matches.sigma_px, huber

    def at(self, T: Sim3) -> tuple[Array, Array, float]:
        """H [6, 6], g [6] and cost of the weighted Huber loss at ``T``."""
        return self._evaluate(T, None)

    def residuals_and_pulls(self, T: Sim3) -> tuple[Array, Array]:
        """Residuals [2, M] at ``T``, and what each match pulls by [6, M]: weighted J' residual."""
        count = len(self._matches)
        residual, pull = np.empty((2, count)), np.empty((6, count))
        self._evaluate(T, _Left(residual.ctypes.data, pull.ctypes.data))
        return residual, pull

    def _evaluate(self, T: Sim3, left: _Left | None) -> tuple[Array, Array, float]:
        given, result = self._given, _Result()
        given.R[:], given.t[:], given.scale = T.R.reshape(-1).tolist(), T.t.tolist(), T.scale
        given.nearest = nearest_depth(self._matches, T)
        out = None if left is None else ctypes.byref(left)
        self._library.call("aq_pose_equations", ctypes.byref(given), ctypes.byref(result), out)
        H = np.array(result.H, dtype=np.float64).reshape(6, 6)
        return H, np.array(result.g, dtype=np.float64), float(result.cost)
