"""Exported networks as describers of pictures' cells: the compact one, and the paper's.

The compact one describes a picture without looking at the other; the paper's looks at both, so that
what it keeps of a picture are tokens, and descriptors come with the pair.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.errors import InputError
from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.compact.quantise import INT8_ENCODER
from aquaflow.prior.contract import Float
from aquaflow.prior.folder import DECODER, ENCODER, read_card
from aquaflow.prior.hybrid import Describer, Half, Picture
from aquaflow.prior.learned_range import MOST_LOG, LearnedRange
from aquaflow.prior.oracle import OracleDescriber
from aquaflow.prior.runtime import NetworkSession, RuntimeSettings

MULTIPLE_PX = 16
"""Sides of the pictures that the compact network takes."""

CELL_PX = 8
"""Pixels of a cell, across and down, in the pictures that the networks take."""

MIDDLE = slice(CELL_PX // 2, None, CELL_PX)
"""Pixels next to the cells' centres."""

METRIC_SIGMA = 0.1
"""Relative error of the metre of the paper's network; assumed, its weights were never run here."""

POINTS_ALPHA = 0.2
"""Metres: the reward of log Q in the loss that the paper's network was trained with."""

SHORTEST = 1e-6
"""Length below which a descriptor has no direction."""


class CompactDescriber:
    """The compact network: descriptors of a picture's cells, whatever the other picture is."""

    metric = False
    unit_sigma = float("inf")
    """It was trained on pairs whose scale was taken out: where the scene is twice as far, its range
    stays nearly the same (docs/measurements.md#learned-depth)."""

    def __init__(self, folder: Path, settings: RuntimeSettings) -> None:
        """Load the exported ``folder``.

        Raises:
            InputError: it is no prior, its files were changed, or it is not there in 8 bits.
            AquaFlowError: onnxruntime is not installed, or lacks the processor asked for.
        """
        card = read_card(folder)
        self.name, self._pixels = card.name, card.width * card.height
        self.variance_factor = card.range_variance_factor
        self._folder, self._settings = folder, settings
        self._encoder = _encoder(folder, INT8_ENCODER in card.files, settings)
        [(self._input, shape)] = self._encoder.inputs.items()
        self._fixed = shape[2:] if all(isinstance(n, int) for n in shape[2:]) else None

    def fitted(
        self,
        image: Picture,  # [H, W, 3] RGB
    ) -> Picture:
        """[h, w, 3] of the size that was exported; if any may be, of so many pixels as that."""
        height, width = image.shape[:2]
        if self._fixed is not None:
            height, width = self._fixed
        else:
            scale = min((self._pixels / (height * width)) ** 0.5, 1.0)
            height, width = (_multiple(scale * side) for side in (height, width))
        return resized(image, height, width)

    def features(
        self,
        picture: Picture,  # [h, w, 3] as fitted
    ) -> Half:
        """[h / 8, w / 8, d] unit descriptors."""
        found = self._encoder({self._input: as_input(picture)})["Dc"][0]
        return np.ascontiguousarray(unit(found.transpose(1, 2, 0)).astype(np.float16))

    def compared(
        self,
        a: Half,  # [h / 8, w / 8, d]
        b: Half,  # [h / 8, w / 8, d]
        camera_a: CameraModel,
        camera_b: CameraModel,
    ) -> CompactPair:
        """Descriptors are the features themselves; ranges come from comparing rays."""
        return CompactPair(self, a, b, camera_a, camera_b)

    def decoded(
        self,
        a: Half,  # [h / 8, w / 8, d]
        b: Half,  # [h / 8, w / 8, d]
        camera_a: CameraModel,
        camera_b: CameraModel,
    ) -> dict[str, Float]:
        """The decoder's outputs."""
        return self._decoder(
            {
                "Dc_a": _channels_first(a.astype(np.float32)),
                "Dc_b": _channels_first(b.astype(np.float32)),
                "rays_a": _channels_first(cell_rays(camera_a, *a.shape[:2])),
                "rays_b": _channels_first(cell_rays(camera_b, *b.shape[:2])),
            }
        )

    @cached_property
    def _decoder(self) -> NetworkSession:
        return NetworkSession(self._folder / DECODER, self._settings)


@dataclass
class CompactPair:
    """Two pictures that the compact network compared. Ranges are nearly monocular, and up to a
    factor (docs/measurements.md#compact-prior)."""

    describer: CompactDescriber
    a: Half
    """[h / 8, w / 8, d]"""
    b: Half
    """[h / 8, w / 8, d]"""
    camera_a: CameraModel
    camera_b: CameraModel

    @property
    def cells(self) -> tuple[Float, Float]:
        return self.a.astype(np.float32), self.b.astype(np.float32)

    @property
    def range_a(self) -> LearnedRange:
        return self._range("ab")

    @property
    def range_b(self) -> LearnedRange:
        return self._range("ba")

    @cached_property
    def confidence(self) -> Float | None:
        return None

    def _range(self, way: str) -> LearnedRange:
        log_variance = np.clip(self._decoded[f"log_variance_{way}"][0], -MOST_LOG, MOST_LOG)
        variance = np.float32(self.describer.variance_factor) * np.exp(log_variance)
        return LearnedRange(self._decoded[f"log_range_{way}"][0], variance)

    @cached_property
    def _decoded(self) -> dict[str, Float]:
        return self.describer.decoded(self.a, self.b, self.camera_a, self.camera_b)


class Mast3rDescriber:
    """The paper's network: descriptors of both pictures, after each has looked at the other."""

    metric = True
    unit_sigma = METRIC_SIGMA

    def __init__(self, folder: Path, settings: RuntimeSettings) -> None:
        """Load the exported ``folder``; raises as the compact one."""
        card = read_card(folder)
        self.name, self._size = card.name, (card.height, card.width)
        self._encoder = NetworkSession(folder / ENCODER, settings)
        self._decoder = NetworkSession(folder / DECODER, settings)

    def fitted(
        self,
        image: Picture,  # [H, W, 3] RGB
    ) -> Picture:
        """[h, w, 3] of the size that was exported."""
        return resized(image, *self._size)

    def features(
        self,
        picture: Picture,  # [h, w, 3] as fitted
    ) -> Half:
        """[1, N, D] tokens."""
        return self._encoder({"image": as_input(picture)})["tokens"].astype(np.float16)

    def compared(
        self,
        a: Half,  # [1, N, D]
        b: Half,  # [1, N, D]
        camera_a: CameraModel,
        camera_b: CameraModel,
    ) -> Mast3rPair:
        """The cameras are not asked for: the network finds its own."""
        return Mast3rPair(self, a, b)

    def decoded(
        self,
        a: Half,  # [1, N, D]
        b: Half,  # [1, N, D]
    ) -> dict[str, Float]:
        """The decoder's outputs; points of both are in the first one's frame."""
        tokens = {"tokens_a": a.astype(np.float32), "tokens_b": b.astype(np.float32)}
        return self._decoder(tokens)


@dataclass
class Mast3rPair:
    """Two pictures after each has looked at the other; decoded once for each way."""

    describer: Mast3rDescriber
    a: Half
    """[1, N, D]"""
    b: Half
    """[1, N, D]"""

    @property
    def cells(self) -> tuple[Float, Float]:
        """[h / 8, w / 8, d] the descriptors at the cells' centres."""
        found = self._decoded
        return found["D_a"][0, MIDDLE, MIDDLE], found["D_b"][0, MIDDLE, MIDDLE]

    @property
    def range_a(self) -> LearnedRange:
        return _range_of_points(self._decoded)

    @cached_property
    def range_b(self) -> LearnedRange:
        """From the pair the other way round: that has its points in b's own frame."""
        return _range_of_points(self.describer.decoded(self.b, self.a))

    @property
    def confidence(self) -> Float | None:
        return None

    @cached_property
    def _decoded(self) -> dict[str, Float]:
        return self.describer.decoded(self.a, self.b)


def _range_of_points(
    found: dict[str, Float],  # outputs of the decoder by name
) -> LearnedRange:
    """Distances of the first picture's points, in metres. Their confidence Q weighed errors in
    training, so that the network expects an error of POINTS_ALPHA / Q metres."""
    distance = np.linalg.norm(found["X_a"][0, MIDDLE, MIDDLE], axis=-1)
    distance = np.maximum(distance, SHORTEST)
    expected = POINTS_ALPHA / found["Q_a"][0, MIDDLE, MIDDLE]
    return LearnedRange(np.log(distance), (expected / distance) ** 2)


def _encoder(folder: Path, has_int8: bool, settings: RuntimeSettings) -> NetworkSession:
    """In 8 bits where that was asked for, or nothing was and it runs on a processor."""
    if settings.precision == "int8" and not has_int8:
        raise InputError(f"{folder} has no {INT8_ENCODER}; use precision: fp32")
    if not has_int8 or settings.precision == "fp32":
        return NetworkSession(folder / ENCODER, settings)
    encoder = NetworkSession(folder / INT8_ENCODER, settings)
    if settings.precision == "auto" and encoder.device != "cpu":
        return NetworkSession(folder / ENCODER, settings)
    return encoder


def describer_in(folder: Path, settings: RuntimeSettings) -> Describer:
    """The describer for the network that ``folder`` holds; raises as they do."""
    name = read_card(folder).name
    if name == "oracle":
        return OracleDescriber(folder)
    kinds: dict[str, Any] = {"compact": CompactDescriber, "mast3r": Mast3rDescriber}
    describer: Describer = kinds[name](folder, settings)
    return describer


def cell_rays(camera: CameraModel, rows: int, columns: int) -> Float:
    """[rows, columns, 2] x / z and y / z of the centres of cells that cover the picture."""
    v, u = np.mgrid[:rows, :columns] + 0.5
    pixels = np.stack([u * camera.width / columns, v * camera.height / rows], -1)
    return camera.unproject(pixels)[..., :2].astype(np.float32)


def _channels_first(
    field: Float,  # [h, w, c]
) -> Float:
    """[1, c, h, w]"""
    return np.ascontiguousarray(field.transpose(2, 0, 1)[None])


def as_input(
    picture: Picture,  # [h, w, 3]
) -> npt.NDArray[np.float32]:
    """[1, 3, h, w] in [0, 1]"""
    return np.ascontiguousarray(picture.transpose(2, 0, 1)[None], dtype=np.float32) / 255.0


def resized(
    image: Picture,  # [H, W, 3]
    height: int,
    width: int,
) -> Picture:
    """[height, width, 3]; pixels are averaged where it becomes smaller."""
    if image.shape[:2] == (height, width):
        return image
    shrinks = height < image.shape[0]
    way = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=way), dtype=np.uint8)


def unit(
    descriptors: Float,  # [..., d]
) -> Float:
    """[..., d] of length 1."""
    length = np.linalg.norm(descriptors, axis=-1, keepdims=True)
    return np.asarray(descriptors / np.maximum(length, SHORTEST), dtype=np.float32)


def _multiple(side: float) -> int:
    return max(MULTIPLE_PX, round(side / MULTIPLE_PX) * MULTIPLE_PX)
