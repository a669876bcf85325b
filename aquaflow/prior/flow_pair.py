"""Pairs whose matches are a flow, and how certain each match is."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior import flow as dense
from aquaflow.prior import homography as sparse
from aquaflow.prior.contract import Float, Keypoints, Mask, RangeUnit
from aquaflow.prior.flow import FlowMatcher, ImageFlow, length, pixel_grid, sample


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


# --------------------------------------------------------------------------------------------------
# Several flows to start from, one after the other, until one explains the pair.
#
# DIS follows displacements up to some 15 % of the picture's width; what is larger must be known
# before it starts. Every start costs as much as the flow itself, so the likely ones come first.

GOOD_SHARE = 0.5
"""A flow that matches this part of the picture needs no rival."""


def best_flow(
    matcher: FlowMatcher,
    a: FlowEncoding,
    b: FlowEncoding,
    starts: Iterable[Float | None],  # [H, W, 2] px each, a to b; None: from nothing
    near: Float | None = None,  # [H, W, 2] px, a to b
) -> ImageFlow:
    """The flow of the first start that explains the pair, or the one whose matches are surest in
    all: where the picture repeats itself, flow from a wrong start matches as much, but comes back
    less well.

    From ``near``, where it is known well, a quicker flow comes first. ``starts`` is asked for the
    next one only when those before were not good enough.
    """
    if near is not None:
        flow = matcher(a.grey, b.grey, a.texture, b.texture, near, quick=True)
        if flow.share >= GOOD_SHARE:
            return flow
    flows: list[ImageFlow] = []
    for start in starts:
        flows.append(matcher(a.grey, b.grey, a.texture, b.texture, start))
        if flows[-1].share >= GOOD_SHARE:
            return flows[-1]
    return flows[0] if len(flows) == 1 else max(flows, key=lambda f: dense.confidence(f).sum())


def from_prediction(
    predicted: Float | None,  # [H, W, 2] px, expected matches
) -> Iterator[Float]:
    """The expected displacement, if something is expected."""
    if predicted is not None:
        height, width = predicted.shape[:2]
        yield predicted - pixel_grid(height, width)


def from_homography(a: FlowEncoding, b: FlowEncoding) -> Iterator[Float]:
    """The homography that most SIFT matches follow, if there is one."""
    H = sparse.homography(a.keypoints, b.keypoints)
    if H is not None:
        height, width = a.grey.shape
        yield sparse.flow_of_homography(H, height, width)
