"""Cells described by their pixels: a network's stand-in that knows shifts, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import RangeUnit
from aquaflow.prior.dense_matching import DenseViews
from aquaflow.prior.mast3r_describer import CELL_PX
from aquaflow.prior.network import LearnedRange, unit

SIDE_PX = 24
"""Of the square around a cell's centre that describes it."""


class PatchDescriber:
    """Describes a cell by the grey values around it, smoothed; counts how often it is asked."""

    name = "patches"
    metric, describes = False, "cells"
    range_unit: RangeUnit = "shared"
    unit_sigma = 0.2

    def __init__(self) -> None:
        self.asked = 0
        self.compared_pairs = 0

    def fit(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        return image

    def features(self, picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.float16]:
        self.asked += 1
        grey = cv2.GaussianBlur(picture[..., 0].astype(np.float32), (0, 0), 2.0)
        pad = (SIDE_PX - CELL_PX) // 2
        padded = cv2.copyMakeBorder(grey, pad, pad, pad, pad, cv2.BORDER_REFLECT)
        windows = np.lib.stride_tricks.sliding_window_view(padded, (SIDE_PX, SIDE_PX))
        patches = windows[::CELL_PX, ::CELL_PX, ::3, ::3]
        flat = patches.reshape(*patches.shape[:2], -1)
        return unit(flat - flat.mean(-1, keepdims=True)).astype(np.float16)

    def compare(
        self,
        a: npt.NDArray[np.float16],
        b: npt.NDArray[np.float16],
        camera_a: CameraModel,
        camera_b: CameraModel,
    ) -> PatchPair:
        self.compared_pairs += 1
        return PatchPair((a.astype(np.float32), b.astype(np.float32)))


@dataclass
class PatchPair:
    """Three units everywhere, known to 30 %."""

    cells: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
    views: tuple[DenseViews, DenseViews] | None = None
    """There and back."""
    confidence = None

    def dense(self, back: bool = False) -> DenseViews | None:
        return None if self.views is None else self.views[back]

    @property
    def range_a(self) -> LearnedRange:
        shape = self.cells[0].shape[:2]
        return LearnedRange(
            np.full(shape, np.log(3.0), np.float32), np.full(shape, 0.09, np.float32)
        )

    @property
    def range_b(self) -> LearnedRange:
        return self.range_a
