"""Pairs whose matches are a flow: confidence, and points from two-view geometry when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.triangulation import triangulate
from aquaflow.geometry.two_view import relative_pose
from aquaflow.prior import flow as dense
from aquaflow.prior import homography as sparse
from aquaflow.prior.contract import Float, Keypoints, Mask

MATCH_SIGMA_PX = 0.2
"""Noise of a refined match: 0.15 px on synthetic dives (prior.refinement)."""

POSE_SAMPLES = 2000
"""Matches that the two-view pose is estimated from."""


@dataclass
class FlowEncoding:
    """A picture made ready for flow; keypoints are detected when first needed."""

    camera: CameraModel
    grey: npt.NDArray[np.uint8]
    texture: Float
    mask: Mask | None = field(default=None, kw_only=True)
    """[H, W] True where the scene is seen; None: everywhere."""

    @cached_property
    def interesting(self) -> Mask:
        return self.texture > dense.MIN_TEXTURE

    @cached_property
    def keypoints(self) -> Keypoints:
        return sparse.detect(self.grey, self.mask)

    def pack(self) -> dict[str, npt.NDArray[Any]]:
        """Its arrays, not copied; keypoints only if they were detected."""
        arrays: dict[str, npt.NDArray[Any]] = {"grey": self.grey, "texture": self.texture}
        if self.mask is not None:
            arrays["mask"] = self.mask
        keypoints = vars(self).get("keypoints")
        if keypoints is not None:
            arrays |= {"pixels": keypoints.pixels, "descriptors": keypoints.descriptors}
        return arrays

    def restore(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
    ) -> None:
        """Take back what was computed when first asked for, and packed."""
        self.mask = arrays.get("mask")
        if "pixels" in arrays:
            self.keypoints = Keypoints(arrays["pixels"], arrays["descriptors"])


class FlowPair:
    """Matches at once; pointmaps, up to scale, on demand."""

    D_a: Float | None = None
    D_b: Float | None = None

    def __init__(self, a: FlowEncoding, b: FlowEncoding, flow: dense.Flow) -> None:
        self._a, self._b, self.flow = a, b, flow

    @cached_property
    def matches(self) -> Float:
        height, width = self._a.grey.shape
        return dense.pixel_grid(height, width) + self.flow.forward

    @property
    def valid(self) -> Mask:
        return self.flow.valid

    @cached_property
    def matches_back(self) -> Float:
        height, width = self._b.grey.shape
        return dense.pixel_grid(height, width) + self.flow.backward

    @cached_property
    def valid_back(self) -> Mask:
        back = self.flow.backward + dense.sample(self.flow.forward, self.matches_back)
        height, width = self._a.grey.shape
        inside = ((self.matches_back > 0.0) & (self.matches_back < (width, height))).all(-1)
        close = np.linalg.norm(back, axis=-1) < dense.OCCLUSION_PX
        return np.asarray(inside & close)

    @cached_property
    def C(self) -> Float:
        return dense.confidence(self.flow)

    @cached_property
    def _geometry(self) -> tuple[Float, Float]:
        """(X_a, Q_a)"""
        return self._triangulated()

    def _triangulated(self) -> tuple[Float, Float]:
        """[H, W, 3] and [H, W]: two-view pose from the matches, every valid match triangulated."""
        height, width = self._a.grey.shape
        X = np.full((height, width, 3), np.nan, np.float32)
        Q = np.zeros((height, width), np.float32)
        rows, columns = np.nonzero(self.valid)
        if len(rows) == 0:
            return X, Q
        pixels_a = np.stack([columns + 0.5, rows + 0.5], -1)
        pixels_b = self.matches[rows, columns].astype(np.float64)
        step = max(1, len(rows) // POSE_SAMPLES)
        T_ba = relative_pose(pixels_a[::step], pixels_b[::step], self._a.camera, self._b.camera)
        if T_ba is None:
            return X, Q
        rays = self._a.camera.unproject(pixels_a)
        points = triangulate(rays, pixels_b, T_ba, self._b.camera, MATCH_SIGMA_PX)
        good = points.good
        X[rows[good], columns[good]] = rays[good] / points.rho[good, None]
        Q[rows[good], columns[good]] = points.rho[good] ** 2 / points.variance[good]
        return X, Q

    @property
    def X_a(self) -> Float:
        return self._geometry[0]

    @property
    def Q_a(self) -> Float:
        return self._geometry[1]

    @cached_property
    def _in_b(self) -> tuple[Float, Float]:
        """(X_b, Q_b): b's pixels take the point of the pixel of a that they match."""
        height, width = self._a.grey.shape
        column = np.clip(np.floor(self.matches_back[..., 0]).astype(int), 0, width - 1)
        row = np.clip(np.floor(self.matches_back[..., 1]).astype(int), 0, height - 1)
        known = self.valid_back
        X = np.where(known[..., None], self.X_a[row, column], np.nan).astype(np.float32)
        return X, np.where(known, self.Q_a[row, column], 0.0).astype(np.float32)

    @property
    def X_b(self) -> Float:
        return self._in_b[0]

    @property
    def Q_b(self) -> Float:
        """[H, W] confidence of X_b; 0 where unknown."""
        return self._in_b[1]
