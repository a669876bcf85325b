"""Exported networks as describers of pictures: the compact one, and which one a folder holds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Float, RangeUnit
from aquaflow.prior.depth_describer import DepthDescriber, as_input, multiple_of, resize
from aquaflow.prior.folder import DECODER, ENCODER, read_card
from aquaflow.prior.mast3r_describer import Mast3rDescriber
from aquaflow.prior.network import (
    MOST_LOG,
    Described,
    Describer,
    Half,
    LearnedRange,
    Picture,
    cell_rays,
    unit,
)
from aquaflow.prior.oracle import OracleDescriber
from aquaflow.prior.runtime import INT8_ENCODER, NetworkSession, RuntimeSettings

MULTIPLE_PX = 16
"""Sides of the pictures that the compact network takes."""


class CompactDescriber:
    """The compact network: descriptors of a picture's cells, whatever the other picture is."""

    metric = False
    describes: Described = "cells"
    range_unit: RangeUnit = "shared"
    unit_sigma = float("inf")
    """It was trained on pairs whose scale was taken out: where the scene is twice as far, its range
    stays nearly the same (notes/2026-11-priors.md#learned-depth)."""

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

    def fit(
        self,
        image: Picture,  # [H, W, 3] RGB
    ) -> Picture:
        """[h, w, 3] of the size that was exported; if any may be, of so many pixels as that."""
        height, width = image.shape[:2]
        if self._fixed is not None:
            height, width = self._fixed
        else:
            scale = min((self._pixels / (height * width)) ** 0.5, 1.0)
            height, width = (multiple_of(scale * side, MULTIPLE_PX) for side in (height, width))
        return resize(image, height, width)

    def features(
        self,
        picture: Picture,  # [h, w, 3] as fitted
    ) -> Half:
        """[h / 8, w / 8, d] unit descriptors."""
        found = self._encoder({self._input: as_input(picture)})["Dc"][0]
        return np.ascontiguousarray(unit(found.transpose(1, 2, 0)).astype(np.float16))

    def compare(
        self,
        a: Half,  # [h / 8, w / 8, d]
        b: Half,  # [h / 8, w / 8, d]
        camera_a: CameraModel,
        camera_b: CameraModel,
    ) -> CompactPair:
        """Descriptors are the features themselves; ranges come from comparing rays."""
        return CompactPair(self, a, b, camera_a, camera_b)

    def decode(
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
    factor; its C makes poses no better (notes/2026-11-priors.md#compact-prior)."""

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

    def dense(self, back: bool = False) -> None:
        """It gives none of all pixels."""

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
        return self.describer.decode(self.a, self.b, self.camera_a, self.camera_b)


def _encoder(folder: Path, has_int8: bool, settings: RuntimeSettings) -> NetworkSession:
    """In 8 bits where that was asked for, or nothing was and it runs on a processor."""
    _refuse_missing_int8(folder, has_int8, settings)
    if not has_int8 or settings.precision in ("fp32", "fp16"):
        return NetworkSession(folder / ENCODER, settings)
    encoder = NetworkSession(folder / INT8_ENCODER, settings)
    if settings.precision == "auto" and encoder.device != "cpu":
        return NetworkSession(folder / ENCODER, settings)
    return encoder


def _refuse_missing_int8(folder: Path, has_int8: bool, settings: RuntimeSettings) -> None:
    if settings.precision == "int8" and not has_int8:
        raise InputError(f"{folder} has no {INT8_ENCODER}; use precision: fp32")


def describer_in(folder: Path, settings: RuntimeSettings) -> Describer:
    """The describer for the network that ``folder`` holds; raises as they do."""
    card = read_card(folder)
    name = card.name
    if name == "oracle":
        return OracleDescriber(folder)
    _refuse_missing_int8(folder, INT8_ENCODER in card.files, settings)
    kinds: dict[str, Any] = {
        "compact": CompactDescriber,
        "depth": DepthDescriber,
        "mast3r": Mast3rDescriber,
    }
    describer: Describer = kinds[name](folder, settings)
    return describer


def _channels_first(
    field: Float,  # [h, w, c]
) -> Float:
    """[1, c, h, w]"""
    return np.ascontiguousarray(field.transpose(2, 0, 1)[None])
