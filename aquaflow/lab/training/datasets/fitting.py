"""Posed pictures made views of the size that a network takes."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import torch

from aquaflow.lab.training.datasets.posed import Posed
from aquaflow.lab.training.datasets.validity import valid_pixels
from aquaflow.lab.training.pairs import ViewBatch


def view_of(
    posed: Posed,
    width: int,
    height: int,
    T_rw: npt.NDArray[np.floating] | None = None,  # [4, 4] world to reference
) -> ViewBatch:
    """[1, ...] the picture's middle, as large as fits; poses are of the camera to ``r``.

    Depth is never averaged: between near and far there is nothing.
    """
    old_height, old_width = posed.depth.shape
    scale = max(width / old_width, height / old_height)
    size = (max(width, round(scale * old_width)), max(height, round(scale * old_height)))
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    window = (slice(top, top + height), slice(left, left + width))
    image = cv2.resize(posed.image, size, interpolation=way)[window]
    depth = cv2.resize(posed.depth, size, interpolation=cv2.INTER_NEAREST)[window]
    valid = cv2.resize(valid_pixels(posed).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)[
        window
    ]
    K = np.diag([size[0] / old_width, size[1] / old_height, 1.0]) @ posed.K
    K[:2, 2] -= (left, top)
    T = posed.T_wc if T_rw is None else T_rw @ posed.T_wc
    # Unknown depths are 1: what is not a number would be one in every sum, masked or not.
    known = valid.astype(bool)
    return ViewBatch(
        torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))[None]).float() / 255.0,
        torch.from_numpy(np.where(known, depth, 1.0)[None]).float(),
        torch.from_numpy(K[None]).float(),
        torch.from_numpy(np.ascontiguousarray(T)[None]).float(),
        torch.from_numpy(known[None]),
    )
