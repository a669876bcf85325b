"""Small bundle adjustment around one reference view: poses, inverse depths and, if asked, focal.

Every point is a pixel of the reference view with an unknown inverse depth, so the points' block of
the normal equations is diagonal and the Schur complement costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.optimise.least_squares import NormalEquations, Rules, minimise
from aquaflow.optimise.robust import Huber

Array = npt.NDArray[np.float64]

HUBER_PX = 1.0
"""Reprojection error where the loss turns linear."""
KERNEL = Huber(HUBER_PX)
MAX_ITERATIONS = 25
"""Limit of the descent."""
STOP_RELATIVE_DECREASE = 1e-4
"""Relative fall of the cost at which the adjustment has converged. With a tenth of it, 24 views of
Curasao took 20 steps instead of 13 to the same residual; trajectories were no more accurate."""
MIN_RHO = 1e-3
"""Points further than 1000 scene units are held there: infinity has no parallax to solve for."""


@dataclass(frozen=True)
class Bundle:
    """Views, points and camera; the reference view is the identity and is not listed."""

    T: list[Sim3]
    """[V] reference to view."""
    rho: Array
    """[P] inverse depth in the reference view."""
    camera: CameraModel


@dataclass(frozen=True)
class BundleResult:
    """The result of an adjustment and its uncertainty."""

    bundle: Bundle
    residual_px: float
    """Median reprojection error over all observations, each times the root of its weight."""
    rho_sigma: Array
    """[P] standard deviation of the inverse depths, poses held."""
    focal_sigma: float
    """Relative standard deviation of the focal length; 0 when it was not solved for."""


def adjust(
    pixels_reference: Array,  # [P, 2] px
    pixels: Array,  # [V, P, 2] px
    weights: Array,  # [V, P]
    start: Bundle,
    solve_focal: bool = False,
    iterations: int = MAX_ITERATIONS,
) -> BundleResult:
    """Least squares of Huber's cost; the scale gauge is fixed at median depth 1.

    ``weights``: information of each match, 1 for the surest, 0 where the view has none.
    """
    system = _System(pixels_reference, pixels, weights, solve_focal)
    rules = Rules(iterations, decrease=STOP_RELATIVE_DECREASE, shrinkage=0.2)
    return system.summary(_normalise(minimise(system, _normalise(start), rules).state))


def _normalise(bundle: Bundle) -> Bundle:
    scale = float(np.median(bundle.rho))
    views = [Sim3(T.R, T.t * scale) for T in bundle.T]
    return Bundle(views, bundle.rho / scale, bundle.camera)


def is_measured(
    pixels: Array,  # [V, P, 2] px
) -> npt.NDArray[np.bool_]:
    """[V, P] matches that are numbers."""
    return np.asarray(np.isfinite(pixels).all(-1))


@dataclass(frozen=True)
class _BundleEquations:
    """Of C numbers of the cameras and P inverse depths."""

    H_cc: Array
    """[C, C]"""
    H_cp: Array
    """[C, P]"""
    H_pp: Array
    """[P] diagonal"""
    g_c: Array
    """[C]"""
    g_p: Array
    """[P]"""
    cost: float

    @property
    def gradient(self) -> Array:
        """[C + P]"""
        return np.concatenate([self.g_c, self.g_p])

    def solve(self, damping: float) -> Array | None:
        """[C + P] damped step, the depths eliminated."""
        cc = self.H_cc + damping * np.diag(np.diag(self.H_cc)) + 1e-6 * np.eye(len(self.H_cc))
        # A matrix times its own transpose is half the work of two.
        root = 1.0 / np.sqrt(self.H_pp * (1.0 + damping) + 1e-6)
        H_cp = self.H_cp * root
        g_c = self.g_c - H_cp @ (root * self.g_p)
        dc = NormalEquations(cc - H_cp @ H_cp.T, g_c, self.cost).solve(0.0)
        if dc is None:
            return None
        return np.concatenate([dc, -(root * self.g_p + H_cp.T @ dc) * root])


class _System:
    """One problem of least squares."""

    def __init__(
        self,
        pixels_reference: Array,  # [P, 2] px
        pixels: Array,  # [V, P, 2] px
        weights: Array,  # [V, P]
        solve_focal: bool,
    ) -> None:
        self.pixels_reference, self.pixels = pixels_reference, pixels
        # One match that is no number would cost the whole system.
        weights = np.where(is_measured(pixels), weights, 0.0)
        self.observed, self._root = weights > 0.0, np.sqrt(weights)
        self.solve_focal = solve_focal
        self._last: tuple[Bundle, tuple[Array, Array, Array]] | None = None

    def residuals(self, bundle: Bundle) -> tuple[Array, Array, Array]:
        """Errors [V, P, 2], camera points Y [V, P, 3] and reference rays [P, 3]."""
        # A step is taken from where the cost was looked at.
        if self._last is None or self._last[0] is not bundle:
            self._last = bundle, self._residuals(bundle)
        return self._last[1]

    def _residuals(self, bundle: Bundle) -> tuple[Array, Array, Array]:
        rays = bundle.camera.unproject(self.pixels_reference)
        Y = np.stack([rays @ T.R.T + bundle.rho[:, None] * T.t for T in bundle.T])
        error = bundle.camera.project(Y) - self.pixels
        behind = Y[..., 2] < 1e-3
        return np.where((self.observed & ~behind)[..., None], error, 0.0), Y, rays

    def _sizes(
        self,
        error: Array,  # [V, P, 2] px
    ) -> Array:
        """[V, P] px of a match of weight 1."""
        return np.asarray(self._root * np.linalg.norm(error, axis=-1))

    def cost(self, bundle: Bundle) -> float:
        error, Y, _ = self.residuals(bundle)
        size = self._sizes(error)
        # A point behind a camera that sees it costs as much as a very bad match.
        wrong = self.observed & (Y[..., 2] < 1e-3)
        return float(KERNEL.cost(size).sum() + 10.0 * HUBER_PX * wrong.sum())

    def _blocks(self, bundle: Bundle) -> tuple[Array, Array, Array, Array, Array]:
        """H_cc, H_cp, H_pp (diagonal), g_c, g_p for cameras (6 each, then log-focal) and points."""
        error, Y, rays = self.residuals(bundle)
        views, count = self.observed.shape
        unknowns = 6 * views + int(self.solve_focal)
        H_cc, H_cp = np.zeros((unknowns, unknowns)), np.zeros((unknowns, count))
        g_c, g_p, H_pp = np.zeros(unknowns), np.zeros(count), np.zeros(count)
        size = self._sizes(error)
        weights = KERNEL.weight(size) * self._root**2 * (Y[..., 2] > 1e-3)
        # View by view, for what belongs to one stays in the processor's cache.
        for v, weight in enumerate(weights):
            Jc, Jp = self._jacobians(bundle, v, Y[v], rays)
            e = np.ascontiguousarray(error[v].T)  # [2, P]
            # A view touches its own six columns and, at the end, the focal length.
            columns = np.arange(6 * v, 6 * v + 6)
            if self.solve_focal:
                columns = np.append(columns, unknowns - 1)
            wJc, wJp, k = Jc * weight, Jp * weight, len(columns)
            H_cc[np.ix_(columns, columns)] += wJc.reshape(k, -1) @ Jc.reshape(k, -1).T
            H_cp[columns] += wJc[:, 0] * Jp[0] + wJc[:, 1] * Jp[1]
            H_pp += wJp[0] * Jp[0] + wJp[1] * Jp[1]
            g_c[columns] += wJc.reshape(k, -1) @ e.reshape(-1)
            g_p += wJp[0] * e[0] + wJp[1] * e[1]
        return H_cc, H_cp, H_pp, g_c, g_p

    def _jacobians(
        self,
        bundle: Bundle,
        v: int,
        Y: Array,  # [P, 3] camera frame
        rays: Array,  # [P, 3] at z = 1
    ) -> tuple[Array, Array]:
        """d error / d camera [6 or 7, 2, P] and d error / d rho [2, P] of view ``v``, whose points
        are at Y. The camera moves by the left tangent: translation, then rotation."""
        camera, T = bundle.camera, bundle.T[v]
        iz = 1.0 / np.maximum(Y[:, 2], 1e-3)
        x, y = Y[:, 0] * iz, Y[:, 1] * iz
        fx, fy = camera.fx, camera.fy
        P = np.zeros((3, 2, len(Y)))  # d error / d Y
        P[0, 0], P[2, 0] = fx * iz, -fx * x * iz
        P[1, 1], P[2, 1] = fy * iz, -fy * y * iz
        Jc = np.empty((7 if self.solve_focal else 6, 2, len(Y)))
        Jc[:3] = P * bundle.rho
        Jc[3], Jc[4], Jc[5] = (
            (-fx * x * y, -fy * (1.0 + y * y)),
            (fx * (1.0 + x * x), fy * x * y),
            (-fx * y, fy * x),
        )
        if self.solve_focal:
            # f scales the projection, and the reference rays shrink as 1 / f.
            shrinks = -(T.R[:, :2] @ rays[:, :2].T)  # [3, P]
            Jc[6] = (P * shrinks[:, None]).sum(0) + np.stack([fx * x, fy * y])
        return Jc, np.tensordot(T.t, P, 1)

    def linearise(self, bundle: Bundle) -> _BundleEquations:
        return _BundleEquations(*self._blocks(bundle), self.cost(bundle))

    def move(
        self,
        bundle: Bundle,
        step: Array,  # [P]
    ) -> Bundle:
        dc, dp = np.split(step, [len(step) - len(bundle.rho)])
        views = []
        for v, T in enumerate(bundle.T):
            R = so3_exp(dc[6 * v + 3 : 6 * v + 6])
            views.append(Sim3(R @ T.R, R @ T.t + dc[6 * v : 6 * v + 3]))
        camera = bundle.camera
        if self.solve_focal:
            camera = camera.with_focal_scaled(float(np.exp(np.clip(dc[-1], -0.2, 0.2))))
        return Bundle(views, np.maximum(bundle.rho + dp, MIN_RHO), camera)

    def summary(self, bundle: Bundle) -> BundleResult:
        error, _, _ = self.residuals(bundle)
        H_cc, H_cp, H_pp, _, _ = self._blocks(bundle)
        size = self._sizes(error)[self.observed]
        sigma_px = max(float(np.median(size)), 0.05) if size.size else float("inf")
        focal_sigma = 0.0
        if self.solve_focal:
            S = H_cc - (H_cp / (H_pp + 1e-6)) @ H_cp.T
            variance = float(np.linalg.pinv(S, hermitian=True)[-1, -1])
            focal_sigma = sigma_px * float(np.sqrt(max(variance, 0.0)))
        rho_sigma = sigma_px / np.sqrt(np.maximum(H_pp, 1e-12))
        return BundleResult(bundle, sigma_px, rho_sigma, focal_sigma)
