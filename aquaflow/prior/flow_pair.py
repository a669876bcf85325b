"""Pairs whose matches are a flow, and how certain each match is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior import flow as dense
from aquaflow.prior import homography as sparse
from aquaflow.prior.contract import Float, Keypoints, Mask, RangeUnit
from aquaflow.prior.fields import length, pixel_grid, sample


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
    """Matches and their confidence; flow alone knows no ranges and has no descriptors."""

    D_a: Float | None = None
    D_b: Float | None = None

    def __init__(self, a: FlowEncoding, b: FlowEncoding, flow: dense.ImageFlow) -> None:
        self._a, self._b, self.flow = a, b, flow

    @cached_property
    def matches(self) -> Float:
        height, width = self._a.grey.shape
        return pixel_grid(height, width) + self.flow.forward

    @property
    def valid(self) -> Mask:
        return self.flow.valid

    @cached_property
    def matches_back(self) -> Float:
        height, width = self._b.grey.shape
        return pixel_grid(height, width) + self.flow.backward

    @cached_property
    def valid_back(self) -> Mask:
        back = self.flow.backward + sample(self.flow.forward, self.matches_back)
        height, width = self._a.grey.shape
        inside = ((self.matches_back > 0.0) & (self.matches_back < (width, height))).all(-1)
        close = length(back) < dense.OCCLUSION_PX
        return np.asarray(inside & close)

    @cached_property
    def C(self) -> Float:
        return dense.confidence(self.flow)

    @property
    def range_unit(self) -> RangeUnit:
        return "shared"

    @property
    def X_a(self) -> Float | None:
        return None

    @property
    def X_b(self) -> Float | None:
        return None

    @property
    def Q_a(self) -> Float | None:
        return None

    @property
    def Q_b(self) -> Float | None:
        return None
