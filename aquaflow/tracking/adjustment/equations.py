"""The normal equations of a joint adjustment, one anchor keyframe at a time.

A point belongs to the keyframe that it was sampled in and has one unknown, its inverse depth there,
so the points' block of the normal equations is diagonal and is eliminated (Schur complement) anchor
by anchor: each leaves a small dense block between the anchor and the keyframes that see its points.

Poses are Sim(3): the scale of a keyframe is the unit of its depths. They step from the right,
T_wc exp(d), as those of the keyframe graph do. Matches see the scale through the prior of the
depths: what a keyframe's pointmap says, in its own unit.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3Batch, hat, right_jacobian_inverse
from aquaflow.keyframes import Pointmap
from aquaflow.optimise.robust import HUBER_LENGTH, Huber
from aquaflow.prior.contract import PairGeometry
from aquaflow.render.library import Library, library_or_none

Array = npt.NDArray[np.float64]
Float = npt.NDArray[np.float32]
Index = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

KERNEL = Huber(HUBER_LENGTH)
"""Of a match, by the length of its error."""
MIN_Z = 1e-3
"""Of the depth at the anchor; a point behind a view is projected as if just in front of it."""
LEAST_CURVATURE = 1e-9
"""Of a depth that nothing measures, in inverse variances."""


@dataclass(frozen=True)
class AnchorMatches:
    """What the V keyframes that see an anchor's P points measured."""

    anchor: int
    """Place among the poses."""
    views: Index
    """[V] places among the poses."""
    rays: Array
    """[P, 3] z = 1"""
    rho: Array
    """[P] inverse depth that the pointmap has."""
    variance: Array
    """[P] of that; infinite where nothing is known."""
    at: Array | Float
    """[V, P, 2] normalised plane; NaN where a point is not seen. In single precision, as matches
    are kept, it takes half the memory; sums are in double precision with either."""
    used: Mask
    """[V, P]"""
    sigma: Array
    """[V] noise of the matches of each pair, normalised plane."""

    @property
    def places(self) -> Index:
        """[1 + V] of the anchor and the views among the poses."""
        return np.concatenate([[self.anchor], self.views])


@dataclass(frozen=True)
class Projected:
    """The points as the views see them from the present poses."""

    R: Array
    """[V, 3, 3] scale times rotation from the anchor to each view."""
    t: Array
    """[V, 3]"""
    Y: Array
    """[V, P, 3] points in the views, over their depth in the anchor."""
    z: Array
    """[V, P] positive"""
    error: Array
    """[V, P, 2] normalised plane; 0 where a point is not seen."""


def project(
    matches: AnchorMatches,
    poses: Sim3Batch,
    rho: Array,  # [P]
) -> Projected:
    """Project the points of an anchor into the views that see them."""
    T_va = _views_from_anchor(matches, poses)
    R = T_va.scale[:, None, None] * T_va.R
    Y = matches.rays @ R.transpose(0, 2, 1) + rho[None, :, None] * T_va.t[:, None, :]
    z = np.maximum(Y[..., 2], MIN_Z)
    error = np.where(matches.used[..., None], Y[..., :2] / z[..., None] - matches.at, 0.0)
    return Projected(R, T_va.t, Y, z, error)


def _views_from_anchor(matches: AnchorMatches, poses: Sim3Batch) -> Sim3Batch:
    """[V] from the anchor to each view."""
    return poses[matches.views].inverse() @ poses[np.full(len(matches.views), matches.anchor)]


@dataclass(frozen=True)
class AnchorEquations:
    """One anchor's part of the normal equations, its depths eliminated; n = 7 (1 + V)."""

    H: Array
    """[n, n]"""
    gradient: Array
    """[n]"""
    gain: Array
    """[P, n] step of a depth by a step of the poses, negative."""
    offset: Array
    """[P] step of a depth while the poses stay, negative."""

    def depth_steps(
        self,
        step: Array,  # [n] of the anchor's and the views' poses
    ) -> Array:
        """[P] steps of the inverse depths that go with a step of the poses."""
        return np.asarray(-self.offset - self.gain @ step)


def anchor_equations(
    matches: AnchorMatches,
    poses: Sim3Batch,
    rho: Array,  # [P]
) -> AnchorEquations:
    """Linearise an anchor's matches at ``poses`` and inverse depths."""
    return equations_and_scores(matches, poses, rho)[0]


def equations_and_scores(
    matches: AnchorMatches,
    poses: Sim3Batch,
    rho: Array,  # [P]
) -> tuple[AnchorEquations, Array]:
    """The same, and [P, n] what each point adds to the gradient: as large as all the rest."""
    library = library_or_none()
    if library is None:
        return equations_by_definition(matches, poses, rho)
    return _CompiledAnchor(library, matches, poses, rho).equations()


def error_lengths(
    matches: AnchorMatches,
    poses: Sim3Batch,
    rho: Array,  # [P]
) -> Array:
    """[V, P] lengths of what is left of the matches, normalised plane; 0 where nothing is seen."""
    library = library_or_none()
    if library is None:
        return np.asarray(np.linalg.norm(project(matches, poses, rho).error, axis=-1))
    return _CompiledAnchor(library, matches, poses, rho).error_lengths()


def equations_by_definition(
    matches: AnchorMatches,
    poses: Sim3Batch,
    rho: Array,  # [P]
) -> tuple[AnchorEquations, Array]:
    """:func:`equations_and_scores` step by step."""
    at = project(matches, poses, rho)
    by_point = _by_point(at)
    by_view = -_point_derivatives(by_point, at.Y, rho)
    by_anchor = _point_derivatives(
        by_point @ at.R[:, None], np.broadcast_to(matches.rays, at.Y.shape), rho
    )
    by_rho = np.einsum("vpij,vj->vpi", by_point, at.t)
    weights = _weights(matches, at.error)
    precision = 1.0 / matches.variance
    views, points = at.z.shape

    weighted = weights[..., None, None] * by_view
    H_pp = (weights * (by_rho**2).sum(-1)).sum(0) + precision + LEAST_CURVATURE
    g_p = (weights * (by_rho * at.error).sum(-1)).sum(0) + precision * (rho - matches.rho)
    H_pc = np.empty((points, 1 + views, 7))
    scores = np.empty((points, 1 + views, 7))
    H = np.zeros((1 + views, 7, 1 + views, 7))
    H_pc[:, 1:] = np.einsum("vpik,vpi->pvk", weighted, by_rho)
    scores[:, 1:] = np.einsum("vpik,vpi->pvk", weighted, at.error)
    anchored = weights[..., None, None] * by_anchor
    H_pc[:, 0] = np.einsum("vpik,vpi->pk", anchored, by_rho)
    scores[:, 0] = np.einsum("vpik,vpi->pk", anchored, at.error)
    flat = (views, 2 * points, 7)
    J_v, W_v = by_view.reshape(flat), weighted.reshape(flat)
    J_a, W_a = by_anchor.reshape(flat), anchored.reshape(flat)
    H[0, :, 0] = (W_a.transpose(0, 2, 1) @ J_a).sum(0)
    across, own = W_v.transpose(0, 2, 1) @ J_a, W_v.transpose(0, 2, 1) @ J_v
    for v in range(views):
        H[1 + v, :, 0], H[0, :, 1 + v] = across[v], across[v].T
        H[1 + v, :, 1 + v] = own[v]

    n = 7 * (1 + views)
    H_pc, scores = H_pc.reshape(points, n), scores.reshape(points, n)
    gain, offset = H_pc / H_pp[:, None], g_p / H_pp
    scores = scores - offset[:, None] * H_pc
    H = H.reshape(n, n) - H_pc.T @ gain
    return AnchorEquations(H, scores.sum(axis=0), gain, offset), scores


def _weights(
    matches: AnchorMatches,
    error: Array,  # [V, P, 2]
) -> Array:
    """[V, P] inverse variances, Huber's."""
    sigma = matches.sigma[:, None]
    size = np.linalg.norm(error, axis=-1) / sigma
    return np.asarray(np.where(matches.used, KERNEL.weight(size) / sigma**2, 0.0))


def _by_point(at: Projected) -> Array:
    """[V, P, 2, 3] derivative of the projection by the point over its anchor's depth."""
    J = np.zeros((*at.z.shape, 2, 3))
    J[..., 0, 0] = J[..., 1, 1] = 1.0 / at.z
    J[..., 2] = -at.Y[..., :2] / (at.z**2)[..., None]
    return J


def _point_derivatives(
    by_point: Array,  # [V, P, 2, 3]
    Y: Array,  # [V, P, 3] over the anchor's depth
    rho: Array,  # [P]
) -> Array:
    """[V, P, 2, 7] derivative by a step d of the frame: Y + u rho + w x Y + q Y."""
    turned = -by_point @ hat(Y)
    grown = np.einsum("vpij,vpj->vpi", by_point, Y)[..., None]
    return np.concatenate([by_point * rho[None, :, None, None], turned, grown], axis=-1)


# --------------------------------------------------------------------------------------------------
# The same in compiled code (native/anchor_equations.h): half of what tracking without a map took
# was the definition (notes/2026-11-speed.md#small-computer).

_COLUMNS = ("R", "t", "rays", "rho", "at", "sigma", "used", "known", "variance")


class _Problem(ctypes.Structure):
    """``AnchorProblem`` of native/anchor_equations.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in _COLUMNS),
        *((name, ctypes.c_int32) for name in ("views", "points")),
        *((name, ctypes.c_double) for name in ("min_z", "huber", "least_curvature")),
    )


class _Sums(ctypes.Structure):
    """``AnchorSums`` of the same file."""

    _fields_ = tuple(
        (name, ctypes.c_void_p) for name in ("H", "gradient", "gain", "offset", "scores")
    )


class _CompiledAnchor:
    """An anchor's matches at some poses and inverse depths [P]."""

    def __init__(
        self,
        library: Library,
        matches: AnchorMatches,
        poses: Sim3Batch,
        rho: Array,  # [P]
    ) -> None:
        T_va = _views_from_anchor(matches, poses)
        numbers = (
            T_va.scale[:, None, None] * T_va.R, T_va.t, matches.rays, rho, matches.at,
            matches.sigma, matches.used, matches.rho, matches.variance,
        )  # fmt: skip
        self._columns = [
            np.ascontiguousarray(each, bool if name == "used" else np.float64)
            for name, each in zip(_COLUMNS, numbers, strict=True)
        ]
        self._library, self._shape = library, matches.used.shape
        addresses = [each.ctypes.data for each in self._columns]
        limits = (MIN_Z, KERNEL.bound, LEAST_CURVATURE)
        self._given = _Problem(*addresses, *matches.used.shape, *limits)

    def error_lengths(self) -> Array:
        lengths = np.empty(self._shape)
        given = ctypes.byref(self._given)
        self._library.call("aq_anchor_errors", given, lengths.ctypes.data)
        return lengths

    def equations(self) -> tuple[AnchorEquations, Array]:
        views, points = self._shape
        n = 7 * (1 + views)
        shapes = ((n, n), (n,), (points, n), (points,), (points, n))
        H, gradient, gain, offset, scores = sums = [np.empty(shape) for shape in shapes]
        out = _Sums(*(each.ctypes.data for each in sums))
        self._library.call("aq_anchor_equations", ctypes.byref(self._given), ctypes.byref(out))
        return AnchorEquations(H, gradient, gain, offset), scores


# --------------------------------------------------------------------------------------------------
# What tracking measured between keyframes, as a term of a joint adjustment.
#
# A link was solved from thousands of dense matches against depths that many frames were fused into:
# it knows more than the anchored points' matches between the same two keyframes.


@dataclass(frozen=True)
class Links:
    """M measured relative poses, T_ab exp(d)."""

    a: Index
    """[M] places among the poses."""
    b: Index
    """[M]"""
    T_ab: Sim3Batch
    """[M]"""
    information: Array
    """[M, 7, 7] of the right tangent."""

    def cost(self, poses: Sim3Batch) -> float:
        """Half the squared differences, in sigmas."""
        r = self._residuals(poses)[0]
        return 0.5 * float(np.einsum("mi,mij,mj->", r, self.information, r))

    def blocks(self, poses: Sim3Batch) -> tuple[Array, Array]:
        """[M, 14, 14] of the normal equations over steps of a and b, and gradients [M, 14]."""
        r, T_ba = self._residuals(poses)
        by_b = right_jacobian_inverse(r)
        J = np.concatenate([-by_b @ T_ba.adjoint(), by_b], axis=2)
        weighted = J.transpose(0, 2, 1) @ self.information
        return weighted @ J, np.asarray((weighted @ r[:, :, None])[:, :, 0])

    def _residuals(self, poses: Sim3Batch) -> tuple[Array, Sim3Batch]:
        T_ba = poses[self.b].inverse() @ poses[self.a]
        return (self.T_ab.inverse() @ T_ba.inverse()).log(), T_ba


# --------------------------------------------------------------------------------------------------
# Points anchored in keyframes: where they were sampled, and where other keyframes see them.

Small = npt.NDArray[np.int16]

ACROSS = 4
"""Columns over rows of the cells that points are spread over is that of a 4:3 picture."""
DOWN = 3
HELD_OUT_EVERY = 5
"""Every fifth point takes no part in an adjustment: it judges it."""
RETURN_PX = 0.4
"""Distance from which a match comes back: twice the noise of a refined match."""


@dataclass
class AnchoredPoints:
    """P points of one keyframe."""

    keyframe: int
    camera: CameraModel
    rows: Small
    """[P] pixel."""
    columns: Small
    """[P] pixel."""
    rho: Float
    """[P] inverse depth as fused, in the unit of the keyframe; 0 where unknown."""
    variance: Float
    """[P] of ``rho``."""
    seen: dict[int, Float] = field(default_factory=dict)
    """By the number of another keyframe: [P, 2] normalised plane; NaN where it is not seen."""

    @property
    def rays(self) -> Array:
        """[P, 3] through the pixels' centres, z = 1."""
        return self.camera.unproject(np.stack([self.columns + 0.5, self.rows + 0.5], axis=-1))

    @property
    def held_out(self) -> Mask:
        """[P] which points judge adjustments and take no part in them."""
        return np.asarray(np.arange(len(self.rho)) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1)

    def take_depths(self, pointmap: Pointmap) -> None:
        """The depths that the keyframe's pointmap has now."""
        self.rho = pointmap.rho[self.rows, self.columns].astype(np.float32)
        self.variance = pointmap.variance[self.rows, self.columns].astype(np.float32)

    def see(
        self,
        other: AnchoredPoints,
        ahead: Float,  # [H, W, 2] px, where every pixel of this keyframe is in the other
        back: Float,  # [H, W, 2] px, where every pixel of the other is in this one
        valid: Mask,  # [H, W] of this keyframe
    ) -> None:
        """Record where another keyframe sees the points: matches that come back to them."""
        pixels = ahead[self.rows, self.columns].astype(np.float64)
        known = valid[self.rows, self.columns] & np.isfinite(pixels).all(axis=1)
        pixels = np.where(known[:, None], pixels, 0.5)
        start = np.stack([self.columns + 0.5, self.rows + 0.5], axis=-1)
        known &= np.linalg.norm(_between(back, pixels) - start, axis=1) < RETURN_PX
        plane = other.camera.unproject(pixels)[:, :2]
        self.seen[other.keyframe] = np.where(known[:, None], plane, np.nan).astype(np.float32)


def sampled_points(
    keyframe: int,
    pointmap: Pointmap,
    texture: Float,  # [H, W]
    interesting: Mask,  # [H, W]
    count: int,
) -> AnchoredPoints:
    """The pixel with most texture in each of about ``count`` cells that has any."""
    height, width = texture.shape
    across = max(1, round(np.sqrt(count * ACROSS / DOWN)))
    down = max(1, round(count / across))
    strength = np.where(interesting, texture, 0.0)
    row_edges = np.linspace(0, height, down + 1).astype(int)
    column_edges = np.linspace(0, width, across + 1).astype(int)
    rows, columns = [], []
    for top, bottom in pairwise(row_edges):
        for left, right in pairwise(column_edges):
            cell = strength[top:bottom, left:right]
            best = int(np.argmax(cell))
            if cell.flat[best] > 0.0:
                rows.append(top + best // (right - left))
                columns.append(left + best % (right - left))
    points = AnchoredPoints(
        keyframe, pointmap.camera, np.array(rows, np.int16), np.array(columns, np.int16),
        np.zeros(0, np.float32), np.zeros(0, np.float32),
    )  # fmt: skip
    points.take_depths(pointmap)
    return points


def see_each_other(a: AnchoredPoints, b: AnchoredPoints, pair: PairGeometry) -> None:
    """Record what the matches of ``pair``, a to b, say about the points of both."""
    a.see(b, pair.matches, pair.matches_back, pair.valid)
    b.see(a, pair.matches_back, pair.matches, pair.valid_back)


def _between(
    field: Float,  # [H, W, 2]
    pixels: Array,  # [M, 2] px
) -> Array:
    """[M, 2] bilinear values."""
    height, width = field.shape[:2]
    at = np.clip(pixels - 0.5, 0.0, (width - 1.0, height - 1.0))
    column = np.minimum(at[:, 0].astype(np.intp), width - 2)
    row = np.minimum(at[:, 1].astype(np.intp), height - 2)
    right, below = at[:, 0] - column, at[:, 1] - row
    above = field[row, column] * (1 - right)[:, None] + field[row, column + 1] * right[:, None]
    under = (
        field[row + 1, column] * (1 - right)[:, None] + field[row + 1, column + 1] * right[:, None]
    )
    return np.asarray(above * (1 - below)[:, None] + under * below[:, None])
