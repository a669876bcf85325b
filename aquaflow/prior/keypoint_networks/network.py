"""What a keypoint network does: find points in one picture, and the same points in another."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from aquaflow.prior.contract import Keypoints
from aquaflow.prior.flow_prior import WARM_UP

Picture = npt.NDArray[np.uint8]
Index = npt.NDArray[np.int64]
Size = tuple[int, int]
"""Height and width, px."""


class KeypointNetwork(Protocol):
    """A detector of keypoints and the matcher that it was trained with."""

    name: str

    def detect(
        self,
        picture: Picture,  # [H, W, 3] RGB
    ) -> Keypoints:
        """The strongest keypoints, in this package's pixels; none where nothing is shown."""
        ...

    def match(self, a: Keypoints, b: Keypoints, size_a: Size, size_b: Size) -> tuple[Index, Index]:
        """Indices [M] into a and into b of keypoints that show the same thing."""
        ...


NO_MATCHES = (np.zeros(0, np.int64), np.zeros(0, np.int64))
"""Of pictures without keypoints."""


def no_keypoints(dimension: int) -> Keypoints:
    """Those of a picture that shows nothing; descriptors have ``dimension`` entries."""
    return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, dimension), np.float32))


def warm_up(network: KeypointNetwork) -> None:
    """Run all of the network once, on a picture that shows nothing."""
    size = WARM_UP[:2]
    keypoints = network.detect(np.zeros(WARM_UP, np.uint8))
    network.match(keypoints, keypoints, size, size)
