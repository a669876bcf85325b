"""LPIPS: the distance of two pictures in the features of a network for recognition, with the
published weights, from files alone (Zhang et al. 2018, version 0.1 of their package)."""

from __future__ import annotations

import functools
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import sha256_of_stream

MEAN, DEVIATION = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Of pictures in [-1, 1], as that package takes them off."""
TINY = 1e-10
"""Keeps features that are all zero from a division by zero, as there."""


@dataclass(frozen=True)
class Backbone:
    """The layers whose features are compared, by their indices in torchvision's ``features``."""

    file: str
    """As torchvision publishes it; the digits are the first of its SHA-256."""
    linear: str
    """SHA-256 of the package's weights of the features."""
    blocks: tuple[tuple[int, ...], ...]
    """Convolutions of each block; behind the last of a block features are compared."""
    pooled: frozenset[int]
    """Blocks that begin with a maximum over ``window`` x ``window``."""
    window: int
    first: tuple[int, int]
    """Stride and padding of the first convolution; others have stride 1 and keep the size."""


BACKBONES = {
    "vgg": Backbone(
        "vgg16-397923af.pth",
        "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
        ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28)),
        frozenset({1, 2, 3, 4}), 2, (1, 1),
    ),
    "alex": Backbone(
        "alexnet-owt-7be5be79.pth",
        "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
        ((0,), (3,), (6,), (8,), (10,)),
        frozenset({1, 2}), 3, (4, 2),
    ),
}  # fmt: skip
"""Simonyan and Zisserman (2014) and Krizhevsky (2014), the two that figures are published of."""


class Lpips:
    """The distance by one backbone."""

    def __init__(
        self,
        backbone: Backbone,
        features: dict[str, Tensor],  # [out, in, k, k] weights and [out] biases of convolutions
        linear: dict[str, Tensor],  # [1, C, 1, 1] weights of the features of each block
    ) -> None:
        """``features``, ``linear``: what is in the files."""
        self._backbone = backbone
        numbers = [number for block in backbone.blocks for number in block]
        self._convolutions = {
            number: (features[f"features.{number}.weight"], features[f"features.{number}.bias"])
            for number in numbers
        }
        self._linear = [linear[f"lin{i}.model.1.weight"] for i in range(len(backbone.blocks))]

    def __call__(
        self,
        image: npt.NDArray[np.floating],  # [H, W, 3] in [0, 1]
        reference: npt.NDArray[np.floating],  # [H, W, 3] in [0, 1]
    ) -> float:
        """0 for equal pictures; around 0.5 for pictures that have little in common."""
        pictures = np.stack([image, reference]).astype(np.float32)
        there = torch.from_numpy(pictures).permute(0, 3, 1, 2) * 2.0 - 1.0
        mean, deviation = (torch.tensor(each)[:, None, None] for each in (MEAN, DEVIATION))
        there, distance = (there - mean) / deviation, 0.0
        with torch.no_grad():
            for number, linear in enumerate(self._linear):
                there = self._block(there, number)
                unit = there / (there.norm(dim=1, keepdim=True) + TINY)
                difference = (unit[:1] - unit[1:]) ** 2
                distance += float(functional.conv2d(difference, linear).mean())
        return distance

    def _block(
        self,
        there: Tensor,  # [2, C, H, W] pictures, or features of the block before
        number: int,
    ) -> Tensor:
        """[2, C, H, W] features of the next block."""
        backbone = self._backbone
        if number in backbone.pooled:
            there = functional.max_pool2d(there, backbone.window, 2)
        for convolution in backbone.blocks[number]:
            weight, bias = self._convolutions[convolution]
            stride, padding = backbone.first if convolution == 0 else (1, weight.shape[-1] // 2)
            there = functional.conv2d(there, weight, bias, stride, padding).relu()
        return there


def load_lpips(folder: Path | None) -> tuple[dict[str, Lpips], str | None]:
    """The distances that can be measured here, by the names of ``BACKBONES``, and in a sentence why
    others cannot.

    Nothing is downloaded: a vehicle's computer has no network, and a metric must not need one.

    Args:
        folder: of the backbones' weights; None for the one that torch keeps such files in.
    """
    return _load(folder or Path(torch.hub.get_dir()) / "checkpoints")


@functools.cache
def _load(folder: Path) -> tuple[dict[str, Lpips], str | None]:
    """Once for all pictures, also what is missing: a damaged file is found by reading all of it."""
    found, missing = dict[str, Lpips](), list[str]()
    for name in BACKBONES:
        try:
            found[name] = _network(name, folder)
        except InputError as error:
            missing.append(str(error))
    return found, "; ".join(dict.fromkeys(missing)) or None


def _network(name: str, folder: Path) -> Lpips:
    """Raises InputError: a file is missing or damaged."""
    backbone, package = BACKBONES[name], importlib.util.find_spec("lpips")
    if package is None or package.origin is None:
        raise InputError(
            "the Python package lpips, which has LPIPS' own weights, is not installed: run "
            "'pip install --no-deps lpips'"
        )
    linear = Path(package.origin).parent / "weights" / "v0.1" / f"{name}.pth"
    digits = Path(backbone.file).stem.rpartition("-")[2]
    return Lpips(backbone, _read(folder / backbone.file, digits), _read(linear, backbone.linear))


def _read(path: Path, digits: str) -> dict[str, Any]:
    """The tensors of a file whose SHA-256 begins with ``digits``.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    if not path.is_file():
        raise InputError(f"weights of LPIPS are not at {path}")
    try:
        with path.open("rb") as file:
            found = sha256_of_stream(file)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {reason_of(error)}") from error
    if not found.startswith(digits):
        raise InputError(f"{path} is damaged or another file: its SHA-256 is not {digits}…")
    tensors: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    return tensors
