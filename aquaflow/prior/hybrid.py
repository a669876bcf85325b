"""The learned prior that tracks: descriptors give coarse matches, flow refines them.

A network distinguishes the cells of a picture, whatever the water, the light and the
distance did to it; but cells are coarse. Dense flow is exact to a fifth of a pixel, but only finds
what is near its start. So flow starts at the descriptors' matches
(notes/2026-11-priors.md#compact-prior).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior import flow as dense
from aquaflow.prior.classical import WARM_UP, FlowPrior, classical_starts
from aquaflow.prior.contract import Encoding, Float, Mask, RangeUnit
from aquaflow.prior.dense_matching import matches_both_ways
from aquaflow.prior.flow_pair import FlowEncoding, FlowPair, from_homography, from_prediction
from aquaflow.prior.network import (
    ComparedPair,
    Described,
    Describer,
    Half,
    Picture,
    spread_over,
)


@dataclass
class HybridEncoding(FlowEncoding):
    """A picture made ready for flow; the network looks at it when first needed."""

    picture: Picture
    describer: Describer

    @cached_property
    def features(self) -> Half:
        """What the network says of the picture alone."""
        return self.describer.features(self.picture)

    def pack(self) -> dict[str, npt.NDArray[Any]]:
        """Its arrays, not copied; keypoints and features only if they were computed."""
        arrays = super().pack() | {"picture": self.picture}
        features = vars(self).get("features")
        return arrays if features is None else arrays | {"features": features}

    def restore(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
    ) -> None:
        """Take back what was computed when first asked for, and packed."""
        super().restore(arrays)
        if "features" in arrays:
            self.features = arrays["features"]


class LazyComparison:
    """The network's view of a pair of encodings, asked for at most once."""

    def __init__(self, a: HybridEncoding, b: HybridEncoding) -> None:
        self._a, self._b = a, b

    @cached_property
    def found(self) -> ComparedPair:
        """What the network says of the pair."""
        a, b = self._a, self._b
        return a.describer.compare(a.features, b.features, a.camera, b.camera)

    @property
    def asked(self) -> bool:
        """True if the network has looked at the pair."""
        return "found" in vars(self)


class HybridPair(FlowPair):
    """Matches of flow; ranges and their confidence are the network's, that of matches is both's."""

    def __init__(
        self,
        a: HybridEncoding,
        b: HybridEncoding,
        flow: dense.ImageFlow,
        comparison: LazyComparison,
    ) -> None:
        super().__init__(a, b, flow)
        self._describer, self._comparison = a.describer, comparison
        self._asked = comparison.asked

    @cached_property
    def C(self) -> Float:
        """The flow's, times the network's where the matches come from it: flow that only confirms
        a prediction needs no second opinion, and asking for one costs more than the flow."""
        certain = dense.confidence(self.flow)
        cells = self._comparison.found.confidence if self._asked else None
        return certain if cells is None else certain * spread_over(cells, *certain.shape)

    @cached_property
    def _in_a(self) -> tuple[Float, Float]:
        """(X_a, Q_a)"""
        return self._comparison.found.range_a.pointmap(self._a.camera)

    @cached_property
    def _in_b(self) -> tuple[Float, Float]:
        """(X_b, Q_b)"""
        return self._comparison.found.range_b.pointmap(self._b.camera)

    @property
    def range_unit(self) -> RangeUnit:
        return self._describer.range_unit

    @property
    def X_a(self) -> Float | None:
        return self._in_a[0]

    @property
    def X_b(self) -> Float | None:
        return self._in_b[0]

    @property
    def Q_a(self) -> Float | None:
        return self._in_a[1]

    @property
    def Q_b(self) -> Float | None:
        return self._in_b[1]


MATCHING: dict[Described, str] = {
    "nothing": FlowPrior.matching,
    "cells": "flow from descriptors of cells",
    "pixels": "flow from points and descriptors of pixels",
}
"""By what the network describes."""
OWN_MATCHES = "points and descriptors of pixels, without flow"
NEAR_SHARE = 0.1
"""Of the width: distance from a prediction that stands alone up to which a match counts."""


class HybridPrior(FlowPrior):
    """Flow that starts from learned matches, behind the prior contract."""

    ranged = True

    def __init__(
        self, describer: Describer, learned_matches: bool = True, own_matches: bool = False
    ) -> None:
        """Without ``learned_matches`` flow starts at keypoints where a prediction fails; with
        ``own_matches`` it is not asked where the network gives points and descriptors of pixels."""
        super().__init__()
        self.name, self.metric = describer.name, describer.metric
        self.unit_sigma = describer.unit_sigma
        self._learned_matches = learned_matches
        self.matching = MATCHING[describer.describes if learned_matches else "nothing"]
        self._own_matches = own_matches and describer.describes == "pixels"
        if self._own_matches:
            self.matching = OWN_MATCHES
        self._describer = describer

    def encode(
        self,
        image: Picture,  # [H, W, 3] RGB
        camera: CameraModel,
        mask: Mask | None = None,  # [H, W] True where the scene is seen
    ) -> HybridEncoding:
        """What dense flow and the network's comparison need of a picture."""
        grey = dense.normalised_grey(image, mask)
        fitted, texture = self._describer.fit(image), dense.texture(grey, mask)
        return HybridEncoding(camera, grey, texture, fitted, self._describer, mask=mask)

    def unpack(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],  # as from pack
        camera: CameraModel,
    ) -> HybridEncoding:
        """The encoding with all that was computed of it."""
        encoding = HybridEncoding(
            camera, arrays["grey"], arrays["texture"], arrays["picture"], self._describer
        )
        encoding.restore(arrays)
        return encoding

    def decode(
        self,
        a: Encoding,
        b: Encoding,
        predicted: Float | None = None,  # [H, W, 2] px, expected matches of a in b
        alone: bool = False,
    ) -> HybridPair:
        """Flow from the prediction; where it fails, unless it stands ``alone``, from the
        descriptors, if the network has any, then from keypoints."""
        assert isinstance(a, HybridEncoding)
        assert isinstance(b, HybridEncoding)
        comparison = LazyComparison(a, b)
        if self._own_matches:
            own = own_matches(comparison.found, a.grey.shape, predicted if alone else None)
            if own is not None:
                return HybridPair(a, b, own, comparison)
        starts = _starts(a, b, predicted, comparison if self._learned_matches else None)
        return HybridPair(a, b, self._flow(a, b, predicted, alone, starts), comparison)

    def warm_up(self) -> None:
        """Run the network once: the first picture of a dive then waits for no preparation."""
        features = self._describer.features(self._describer.fit(np.zeros(WARM_UP, np.uint8)))
        height, width, _ = WARM_UP
        camera = CameraModel(width, height, width, width, 0.5 * width, 0.5 * height)
        learned_range = self._describer.compare(features, features, camera, camera).range_a
        learned_range.pointmap(camera)


def _starts(
    a: HybridEncoding,
    b: HybridEncoding,
    predicted: Float | None,  # [H, W, 2] px, expected matches of a in b
    comparison: LazyComparison | None,
) -> Iterator[Float | None]:
    if a.describer.describes == "nothing":
        yield from classical_starts(a, b, predicted)
        return
    yield from from_prediction(predicted)
    flow = None if comparison is None else learned_flow(comparison.found, *a.grey.shape)
    if flow is not None:
        yield flow
    yield from from_homography(a, b)
    yield None


def learned_flow(found: ComparedPair, height: int, width: int) -> Float | None:
    """[height, width, 2] px from a to b: of all pixels where the network gives points and
    descriptors of them, else of cells; None where it gives no matches, or too few agree."""
    views = found.dense()
    if views is not None:
        return views.flow(height, width)
    return None if found.cells is None else coarse_flow(*found.cells, height, width)


def own_matches(
    found: ComparedPair,
    size: tuple[int, ...],  # height and width, px
    near: Float | None,  # [height, width, 2] px, matches near which alone others count
) -> dense.ImageFlow | None:
    """The network's matches of all pixels, as published; None of a pair that it does not know."""
    there, back = found.dense(), found.dense(back=True)
    if there is None or back is None:
        return None
    height, width = size
    flow = matches_both_ways(there, back, height, width)
    if near is None:
        return flow
    off = dense.length(dense.pixel_grid(height, width) + flow.forward - near)
    return replace(flow, valid=flow.valid & (off < NEAR_SHARE * width))


# --------------------------------------------------------------------------------------------------
# Where a picture went, coarsely: mutual nearest neighbours among descriptors of its cells.
#
# Every cell votes alone, so many are wrong; those that follow the motion of most, or that of many
# neighbours, are seldom so. Their flow is spread smoothly over the picture: good enough for dense
# flow to start from.

Index = npt.NDArray[np.intp]

NEIGHBOUR_CELLS = 1.2
"""Neighbours' displacements differ by less; 0.7 are a turn of 40 degrees or 1.7 times the size."""
MIN_SUPPORT = 2
"""Neighbours, of 8, that went the same way. By chance two do for one of 2,000 cells."""
MIN_CELLS = 12
"""Fewer matched cells than this give no flow."""
MOTION_CELLS = 2.0
"""Distance from the motion of the whole picture up to which a cell follows it."""
OWN_WAY_SUPPORT = 5
"""Neighbours with which a cell may go another way: what stands nearer moves further."""
MOTION_DRAWS = 2000
"""At most, of four cells each, to find that motion; measured on survey pictures that share a third
of their view: with it 25 % of the pixels are matched, as from SIFT, and 4 % without."""
OWN_CELLS = 0.3
"""Difference from the motion of the whole picture that is only noise of single cells: without it,
planes start 0.5 instead of 1.0 px off."""
FARTHEST_CELLS = 100.0
"""On the horizon of that motion displacements have no end."""
HORIZON = 1e-3
"""Least absolute value of the homogeneous coordinate that is divided by."""
SMOOTH_CELLS = 1.5
"""Sigma of the smoothing."""
MOTION_WEIGHT = 0.02
"""Of the motion of the whole picture, in matched cells per cell: it decides where none matched."""


def coarse_flow(
    a: Float,  # [h, w, d] unit descriptors of a's cells
    b: Float,  # [h', w', d]
    height: int,
    width: int,
) -> Float | None:
    """[height, width, 2] px, smooth displacement from a to b; None where too few cells agree."""
    if a.shape[-1] != b.shape[-1] or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return None
    moved, mutual = mutual_matches(a, b)
    support = _support(moved, mutual)
    motion = _whole_motion(moved, mutual & (support >= MIN_SUPPORT))
    if motion is None:
        return None
    follows = np.linalg.norm(moved - motion, axis=-1) < MOTION_CELLS
    good = mutual & (support >= np.where(follows, MIN_SUPPORT, OWN_WAY_SUPPORT))
    rows, columns = a.shape[:2]
    smooth = _smooth(moved, good, motion)
    cells = cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR)
    cell_px = np.array([width / columns, height / rows])
    return np.asarray(cells * cell_px, dtype=np.float32)


def mutual_matches(
    a: Float,  # [h, w, d]
    b: Float,  # [h', w', d]
) -> tuple[Float, Mask]:
    """[h, w, 2] displacement in a's cells, to the fraction of a cell; [h, w] is it mutual?"""
    (rows, columns, d), (rows_b, columns_b, _) = a.shape, b.shape
    scores = a.reshape(-1, d).astype(np.float32) @ b.reshape(-1, d).astype(np.float32).T
    own, there = np.arange(rows * columns), scores.argmax(axis=1)
    mutual = scores.argmax(axis=0)[there] == own
    v, u = there // columns_b, there % columns_b
    x = (u + _peak(scores, own, there, u, columns_b, 1) + 0.5) * (columns / columns_b)
    y = (v + _peak(scores, own, there, v, rows_b, columns_b) + 0.5) * (rows / rows_b)
    moved = np.stack([x - own % columns - 0.5, y - own // columns - 0.5], -1)
    shape = (rows, columns)
    return moved.reshape(*shape, 2).astype(np.float32), np.asarray(mutual).reshape(shape)


def _peak(
    scores: Float,  # [N, M]
    own: Index,  # [N]
    best: Index,  # [N]
    position: Index,  # [N] of the best along the axis
    length: int,
    step: int,
) -> npt.NDArray[np.float64]:
    """[N] in [-0.5, 0.5]: top of the parabola through the best cell and its neighbours."""
    inside = (position > 0) & (position < length - 1)
    top = scores[own, best].astype(np.float64)
    before = scores[own, np.where(inside, best - step, best)]
    after = scores[own, np.where(inside, best + step, best)]
    curvature = 2.0 * top - before - after
    shift = np.where(curvature > 1e-9, (after - before) / (2.0 * np.maximum(curvature, 1e-9)), 0.0)
    return np.asarray(np.clip(shift, -0.5, 0.5))


def _support(
    moved: Float,  # [h, w, 2]
    mutual: Mask,  # [h, w]
) -> npt.NDArray[np.int64]:
    """[h, w] neighbours that went the same way."""
    rows, columns = mutual.shape
    matched = np.where(mutual[..., None], moved, np.inf)
    padded = np.pad(matched, ((1, 1), (1, 1), (0, 0)), constant_values=np.inf)
    support = np.zeros(mutual.shape, dtype=np.int64)
    for down in (0, 1, 2):
        for right in (0, 1, 2):
            if (down, right) == (1, 1):
                continue
            neighbour = padded[down : down + rows, right : right + columns]
            support += np.linalg.norm(neighbour - moved, axis=-1) < NEIGHBOUR_CELLS
    return support


def _whole_motion(
    moved: Float,  # [h, w, 2]
    candidates: Mask,  # [h, w]
) -> Float | None:
    """[h, w, 2] the homography that most candidates follow; None where too few do."""
    row, column = np.nonzero(candidates)
    if len(row) < MIN_CELLS:
        return None
    here = np.stack([column, row], -1).astype(np.float32)
    H, follows = cv2.findHomography(
        here, here + moved[candidates], cv2.RANSAC, MOTION_CELLS, maxIters=MOTION_DRAWS
    )
    if H is None or not np.isfinite(H).all() or int(follows.sum()) < MIN_CELLS:
        return None
    y, x = np.mgrid[: candidates.shape[0], : candidates.shape[1]]
    there = np.stack([x, y, np.ones_like(x)], -1).astype(np.float64) @ H.T
    w = np.where(np.abs(there[..., 2:]) < HORIZON, HORIZON, there[..., 2:])
    motion = there[..., :2] / w - np.stack([x, y], -1)
    return np.asarray(np.clip(motion, -FARTHEST_CELLS, FARTHEST_CELLS), dtype=np.float32)


def _smooth(
    moved: Float,  # [h, w, 2]
    good: Mask,  # [h, w]
    motion: Float,  # [h, w, 2]
) -> Float:
    """[h, w, 2]: the motion of all, and what the good cells around differ from it."""
    weight = good.astype(np.float32)
    residual = (moved - motion) * weight[..., None]
    total = cv2.GaussianBlur(weight, (0, 0), SMOOTH_CELLS)
    spread = cv2.GaussianBlur(residual, (0, 0), SMOOTH_CELLS)
    own = spread / (total + MOTION_WEIGHT)[..., None]
    size = np.maximum(np.linalg.norm(own, axis=-1, keepdims=True), OWN_CELLS)
    return np.asarray(motion + own * (1.0 - (OWN_CELLS / size) ** 2), dtype=np.float32)
