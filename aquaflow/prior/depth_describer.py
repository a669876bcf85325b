"""Any monocular depth network as a prior: it knows ranges, and flow finds matches without it.

What such a network takes and gives is in its card (docs/prior.md#depth-network). Its depths enter
tracking as any learned range does: in units that are found by what is triangulated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Float
from aquaflow.prior.folder import CARD, NETWORK, UNITS, DepthCard, read_card
from aquaflow.prior.network import METRIC_SIGMA, Described, Half, LearnedRange, cell_rays
from aquaflow.prior.runtime import NetworkSession, RuntimeSettings

FARTHEST = 0.1
"""Affine inverse depth that the farthest pixel gets, where 1 is the spread of nearly all: it has to
be positive to be the inverse of something, and tracking finds the true shift."""
NEARLY_ALL = (5.0, 95.0)
"""Percentiles."""


class DepthDescriber:
    """A network that says how deep each pixel of one picture is."""

    describes: Described = "nothing"

    def __init__(self, folder: Path, settings: RuntimeSettings) -> None:
        """Load the network of ``folder``.

        Raises:
            InputError: it is no prior, was changed, or does not have the names of its card.
            AquaFlowError: onnxruntime is not installed, or lacks the processor asked for.
        """
        card = read_card(folder)
        if card.depth is None:
            raise InputError(f"{folder / CARD} says nothing of depth; describe the network again")
        self.name, self.metric, self._card = card.name, card.metric, card.depth
        self.unit_sigma = METRIC_SIGMA if card.metric else float("inf")
        self.range_unit = UNITS[card.depth.unit]
        self._pixels = card.width * card.height
        self._network = NetworkSession(folder / NETWORK, settings)
        shape = _shape_of_input(self._network, card.depth)
        sides = [side for side in shape[-2:] if isinstance(side, int)]
        self._frame = (sides[0], sides[1]) if len(sides) == 2 else None
        self._views = (1,) * (len(shape) - 4)

    def fit(
        self,
        image: Picture,  # [H, W, 3] RGB
    ) -> Picture:
        """[h, w, 3] with its aspect ratio: in a frame of the size that the network takes, else of
        as many pixels as the card says."""
        height, width = image.shape[:2]
        if self._frame is not None:
            return self._framing(height, width).frame(image)
        scale, step = (self._pixels / (height * width)) ** 0.5, self._card.multiple_px
        return resize(image, multiple_of(scale * height, step), multiple_of(scale * width, step))

    def features(
        self,
        picture: Picture,  # [h, w, 3] as fitted
    ) -> Half:
        """[h', w', 2] logarithms of depth and of its relative sigma; NaN where unknown."""
        found = self._network({self._card.input: self._normalise(picture)})
        log_depth = self._log_depth(_plane(found, self._card.output))
        log_sigma = np.full_like(log_depth, np.log(self._card.relative_error))
        if self._card.confidence is not None:
            log_sigma = self._log_sigma(_plane(found, self._card.confidence), log_depth.shape)
        with np.errstate(over="ignore"):  # becomes infinite, and so unknown
            return np.stack([log_depth, log_sigma], -1).astype(np.float16)

    def compare(
        self,
        a: Half,  # [h', w', 2]
        b: Half,  # [h', w', 2]
        camera_a: CameraModel,
        camera_b: CameraModel,
    ) -> DepthPair:
        """What it says of each; pictures are not compared."""
        return DepthPair(self._range(a, camera_a), self._range(b, camera_b))

    def _range(
        self,
        features: Half,  # [h', w', 2]
        camera: CameraModel,
    ) -> LearnedRange:
        if self._frame is not None:
            features = self._framing(camera.height, camera.width).cut(features)
        log_depth, log_sigma = np.moveaxis(features.astype(np.float32), -1, 0)
        rays = cell_rays(camera, *log_depth.shape)
        with np.errstate(over="ignore"):
            variance = np.exp(2.0 * log_sigma)
        return LearnedRange(log_depth + 0.5 * np.log1p((rays**2).sum(-1)), variance)

    def _framing(self, height: int, width: int) -> ImagePadding:
        assert self._frame is not None
        return ImagePadding.of(height, width, self._frame, self._card.multiple_px)

    def _normalise(
        self,
        picture: Picture,  # [h, w, 3]
    ) -> npt.NDArray[np.float32]:
        """[1, 3, h, w], or with a number of views before the channels."""
        ordered = picture if self._card.channels == "rgb" else picture[..., ::-1]
        mean, std = (
            np.array(values, np.float32)[:, None, None]
            for values in (self._card.mean, self._card.std)
        )
        image = (as_input(ordered) - mean) / std
        return np.asarray(image.reshape(1, *self._views, *image.shape[1:]))

    def _log_depth(
        self,
        values: Float,  # [h', w'] as the network has them
    ) -> Float:
        """[h', w'] NaN where it gives no depth."""
        if self._card.measure == "log_depth":
            return values
        if self._card.unit == "affine":
            values = _positive(values)
        with np.errstate(divide="ignore", invalid="ignore"):
            log_values = np.log(np.where(values > 0.0, values, np.nan))
        return log_values if self._card.measure == "depth" else -log_values

    def _log_sigma(
        self,
        confidence: Float,  # [h', w'] or of another size
        shape: tuple[int, ...],
    ) -> Float:
        """[h', w'] NaN where the network gives none."""
        if confidence.shape != shape:
            resized_to = cv2.resize(confidence, (shape[1], shape[0]))
            confidence = np.asarray(resized_to, dtype=np.float32)
        if self._card.confidence_kind == "log_variance":
            return 0.5 * confidence
        with np.errstate(divide="ignore", invalid="ignore"):
            log_value = np.log(np.where(confidence > 0.0, confidence, np.nan))
        if self._card.confidence_kind == "sigma":
            return log_value
        return np.float32(np.log(self._card.relative_error)) - log_value


@dataclass(frozen=True)
class DepthPair:
    """Two pictures, of each of which the network has said how deep it is."""

    range_a: LearnedRange
    range_b: LearnedRange

    @property
    def cells(self) -> None:
        return None

    def dense(self, back: bool = False) -> None:
        """It gives none of all pixels."""

    @property
    def confidence(self) -> None:
        return None


def _shape_of_input(network: NetworkSession, card: DepthCard) -> tuple[int | str, ...]:
    """Shape of the picture that it takes; a name in it is a size that may change."""
    if list(network.inputs) != [card.input]:
        raise InputError(
            f"the network takes {', '.join(network.inputs)} and not {card.input} alone; describe "
            "it again"
        )
    for name in (card.output, card.confidence):
        if name is not None and name not in network.outputs:
            raise InputError(
                f"the network has no output {name} but {', '.join(network.outputs)}; describe it "
                "again"
            )
    shape = network.inputs[card.input]
    if len(shape) not in (4, 5) or (isinstance(shape[-3], int) and shape[-3] != 3):
        raise InputError(
            f"input {card.input} has the shape {list(shape)} and not [1, 3, height, width]; export "
            "the network so"
        )
    return shape


def _plane(
    found: dict[str, npt.NDArray[np.float32]],  # [...] each
    name: str,
) -> Float:
    """[h', w'] the output of one picture, whatever axes of length 1 it has."""
    values = np.squeeze(found[name])
    if values.ndim != 2:
        raise InputError(
            f"output {name} has the shape {list(found[name].shape)}, which is not one number for "
            "each pixel; describe the network with another output"
        )
    return np.asarray(values, dtype=np.float32)


def _positive(
    values: Float,  # [h', w'] inverse depths up to scale and shift
) -> Float:
    """[h', w'] another scale and shift that makes all positive; NaN where all are alike."""
    sound = np.isfinite(values)
    if not sound.any():
        return np.full_like(values, np.nan)
    low, high = np.percentile(values[sound], NEARLY_ALL)
    if not high > low:
        return np.full_like(values, np.nan)
    least = values[sound].min()
    return np.asarray(np.where(sound, (values - least) / (high - low) + FARTHEST, np.nan))


# --------------------------------------------------------------------------------------------------
# How a picture becomes a network's input of another size, and what of the output shows it.

Picture = npt.NDArray[np.uint8]
Scalar = TypeVar("Scalar", bound=np.generic)

GREY = 127
"""Of what lies around a picture: the middle of the scale, and nothing after normalisation."""


@dataclass(frozen=True)
class ImagePadding:
    """A picture inside a larger one of fixed size: whole, and not stretched.

    Its sides there are whole cells of the network, so that the cells that show it cover it evenly;
    what lies around it is cut off from every output.
    """

    frame_height: int
    """px, as are all"""
    frame_width: int
    top: int
    left: int
    height: int
    width: int

    @staticmethod
    def of(height: int, width: int, frame: tuple[int, int], cell_px: int) -> ImagePadding:
        """The padding of a picture of ``height`` x ``width`` px in the middle of a ``frame``
        (height, width), as large as fits."""
        scale = min(frame[0] / height, frame[1] / width)
        inner = [
            min(max(round(scale * side / cell_px), 1), available // cell_px) * cell_px
            for side, available in zip((height, width), frame, strict=True)
        ]
        before = [
            (available - side) // 2 // cell_px * cell_px
            for side, available in zip(inner, frame, strict=True)
        ]
        return ImagePadding(*frame, *before, *inner)

    def frame(
        self,
        image: Picture,  # [H, W, 3]
    ) -> Picture:
        """[frame_height, frame_width, 3]"""
        framed = np.full((self.frame_height, self.frame_width, 3), GREY, np.uint8)
        inside = resize(image, self.height, self.width)
        framed[self.top : self.top + self.height, self.left : self.left + self.width] = inside
        return framed

    def cut(
        self,
        field: npt.NDArray[Scalar],  # [h, w, ...] covers the frame evenly
    ) -> npt.NDArray[Scalar]:
        """[h', w', ...] what of it shows the picture."""
        down, across = field.shape[0] / self.frame_height, field.shape[1] / self.frame_width
        rows = slice(round(self.top * down), round((self.top + self.height) * down))
        columns = slice(round(self.left * across), round((self.left + self.width) * across))
        return field[rows, columns]


def as_input(
    picture: Picture,  # [h, w, 3]
) -> npt.NDArray[np.float32]:
    """[1, 3, h, w] in [0, 1]"""
    return np.ascontiguousarray(picture.transpose(2, 0, 1)[None], dtype=np.float32) / 255.0


def resize(
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


def multiple_of(side: float, step: int) -> int:
    """The multiple of ``step`` next to ``side``; at least one."""
    return max(step, round(side / step) * step)
