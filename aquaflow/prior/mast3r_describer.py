"""The paper's network behind the hybrid prior: it looks at both pictures of a pair.

What it keeps of a picture are tokens; descriptors, points and confidences come with the pair.
Pictures keep their aspect ratio: they lie in a frame of the exported size, and what lies around
them is cut off from all that comes back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Float, RangeUnit
from aquaflow.prior.dense_matching import DenseViews
from aquaflow.prior.depth_describer import ImagePadding, as_input
from aquaflow.prior.folder import DECODER, ENCODER, read_card
from aquaflow.prior.network import (
    METRIC_SIGMA,
    SHORTEST,
    Described,
    Half,
    LearnedRange,
    Picture,
    unit,
)
from aquaflow.prior.runtime import NetworkSession, RuntimeSettings

CELL_PX = 8
"""Pixels of a cell, across and down, in the pictures that the network takes."""

MIDDLE = slice(CELL_PX // 2, None, CELL_PX)
"""Pixels next to the cells' centres."""

POINTS_ALPHA = 0.2
"""Metres: the reward of log Q in the loss that the paper's network was trained with."""


class Mast3rDescriber:
    """The paper's network: descriptors of both pictures, after each has looked at the other."""

    metric = True
    describes: Described = "pixels"
    unit_sigma = METRIC_SIGMA
    range_unit: RangeUnit = "shared"

    def __init__(self, folder: Path, settings: RuntimeSettings) -> None:
        """Load the exported ``folder``; raises as the compact one."""
        card = read_card(folder)
        self.name, self._size = card.name, (card.height, card.width)
        self.threads = settings.threads
        self._encoder = NetworkSession(folder / ENCODER, settings)
        self._decoder = NetworkSession(folder / DECODER, settings)

    def fit(
        self,
        image: Picture,  # [H, W, 3] RGB
    ) -> Picture:
        """[h, w, 3] of the size that was exported, with the picture in its middle."""
        return self._framing(*image.shape[:2]).frame(image)

    def features(
        self,
        picture: Picture,  # [h, w, 3] as fitted
    ) -> Half:
        """[1, N, D] tokens."""
        return self._encoder({"image": as_input(picture)})["tokens"].astype(np.float16)

    def compare(
        self,
        a: Half,  # [1, N, D]
        b: Half,  # [1, N, D]
        camera_a: CameraModel,
        camera_b: CameraModel,
    ) -> Mast3rPair:
        """Comparison of the cameras only the pictures' sizes: the network finds the rest itself."""
        framings = (self._framing(camera.height, camera.width) for camera in (camera_a, camera_b))
        return Mast3rPair(self, a, b, *framings)

    def decode(
        self,
        a: Half,  # [1, N, D]
        b: Half,  # [1, N, D]
    ) -> Mapping[str, Float]:
        """The decoder's outputs, each copied from a GPU when it is asked for: few of them are.
        Points of both are in the first one's frame."""
        tokens = {"tokens_a": a.astype(np.float32), "tokens_b": b.astype(np.float32)}
        return self._decoder.outputs_of(tokens)

    def _framing(self, height: int, width: int) -> ImagePadding:
        return ImagePadding.of(height, width, self._size, CELL_PX)


@dataclass
class Mast3rPair:
    """Two pictures after each has looked at the other; decoded once for each way."""

    describer: Mast3rDescriber
    a: Half
    """[1, N, D]"""
    b: Half
    """[1, N, D]"""
    framing_a: ImagePadding
    framing_b: ImagePadding

    @property
    def cells(self) -> tuple[Float, Float]:
        """[h / 8, w / 8, d] the descriptors at the cells' centres."""
        found = self._decoded_back
        return _at_cells(found["D_b"], self.framing_a), _at_cells(found["D_a"], self.framing_b)

    def dense(self, back: bool = False) -> DenseViews:
        """To match a in b from the pair the other way round: that has the points of both in b's own
        frame, whose rays are searched."""
        found = self._decoded if back else self._decoded_back
        sought, searched = self.framing_a, self.framing_b
        if back:
            sought, searched = searched, sought
        return DenseViews(
            sought.cut(found["X_b"][0]),
            searched.cut(found["X_a"][0]),
            unit(sought.cut(found["D_b"][0])),
            unit(searched.cut(found["D_a"][0])),
            self.describer.threads,
        )

    @property
    def range_a(self) -> LearnedRange:
        return _range_of_points(self._decoded, self.framing_a)

    @property
    def range_b(self) -> LearnedRange:
        """From the pair the other way round: that has its points in b's own frame."""
        return _range_of_points(self._decoded_back, self.framing_b)

    @cached_property
    def confidence(self) -> Float:
        """C of the descriptors weighed matching errors in training, up to a factor without meaning:
        what is as sure as the picture's median or surer keeps its weight."""
        C = _at_cells(self._decoded_back["C_b"], self.framing_a)
        sound = np.isfinite(C)
        if not sound.any():
            return np.ones_like(C)
        usual = max(float(np.median(C[sound])), SHORTEST)
        return np.asarray(np.where(sound, np.clip(C / usual, 0.0, 1.0), 1.0), dtype=np.float32)

    @cached_property
    def _decoded(self) -> Mapping[str, Float]:
        return self.describer.decode(self.a, self.b)

    @cached_property
    def _decoded_back(self) -> Mapping[str, Float]:
        return self.describer.decode(self.b, self.a)


def _at_cells(
    field: Float,  # [1, h, w, ...] of the frame's pixels
    framing: ImagePadding,
) -> Float:
    """[h', w', ...] at the centres of the cells that show the picture."""
    return framing.cut(field[0, MIDDLE, MIDDLE])


def _range_of_points(
    found: Mapping[str, Float],  # outputs of the decoder by name
    framing: ImagePadding,
) -> LearnedRange:
    """Distances of the first picture's points, in metres. Their confidence Q weighed errors in
    training, so that the network expects an error of POINTS_ALPHA / Q metres."""
    distance = np.linalg.norm(_at_cells(found["X_a"], framing), axis=-1)
    distance = np.maximum(distance, SHORTEST)
    expected = POINTS_ALPHA / _at_cells(found["Q_a"], framing)
    return LearnedRange(np.log(distance), (expected / distance) ** 2)
