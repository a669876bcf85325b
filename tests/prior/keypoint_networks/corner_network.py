"""A keypoint network's stand-in: corners described by the pixels around them."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.prior.contract import Keypoints

SIDE_PX = 17
"""Of the square that describes a corner."""
CORNERS = 400


class CornerNetwork:
    """Knows shifts and nothing else; counts how often it looks at a picture."""

    name = "corners"

    def __init__(self) -> None:
        self.looked = 0

    def detect(self, picture: npt.NDArray[np.uint8]) -> Keypoints:
        self.looked += 1
        grey = np.ascontiguousarray(picture[..., 0])
        corners = cv2.goodFeaturesToTrack(grey, CORNERS, 0.01, 4)
        if corners is None:
            return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, SIDE_PX**2), np.float32))
        places = corners[:, 0].astype(np.float32)
        patches = np.array(
            [
                cv2.getRectSubPix(grey, (SIDE_PX, SIDE_PX), place.tolist()).ravel()
                for place in places
            ],
            np.float32,
        )
        patches -= patches.mean(1, keepdims=True)
        patches /= np.linalg.norm(patches, axis=1, keepdims=True) + 1e-6
        return Keypoints(places + 0.5, patches)

    def match(
        self, a: Keypoints, b: Keypoints, size_a: tuple[int, int], size_b: tuple[int, int]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        if len(a.pixels) == 0 or len(b.pixels) == 0:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        alike = a.descriptors @ b.descriptors.T
        there, own = alike.argmax(1), np.arange(len(alike))
        mutual = alike.argmax(0)[there] == own
        return own[mutual], there[mutual]
