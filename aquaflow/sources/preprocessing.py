"""From a source's picture to the one that is mapped: crop, calibration, width, undistortion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.config import SourceConfig
from aquaflow.config.cameras import crop_sides
from aquaflow.geometry.camera import ASPECT_TOLERANCE, CameraModel, guess_camera
from aquaflow.geometry.rectification import Rectifier
from aquaflow.types import Frame

DEFAULT_WIDTH_PX = 480
"""Width mapped when none is asked for: two CPU cores track and map a few such frames a second."""

MIN_SIDE_PX = 16
"""Optical flow needs patches of 8 pixels at two scales; smaller pictures hold no motion."""

Box = tuple[int, int, int, int]


class Preparation:
    """Prepares every frame of one recording in the same way."""

    def __init__(self, config: SourceConfig, calibration: CameraModel | None) -> None:
        """Raises ConfigError where the mask of ``config`` is none."""
        self._config, self._calibration = config, calibration
        self._rectifier: Rectifier | None = None
        self._mask = None if config.mask is None else read_mask(config.mask)
        self._fitted_mask: Mask | None = None
        self._box: Box = (0, 0, 0, 0)
        self._size = (0, 0)

    @property
    def calibration(self) -> CameraModel | None:
        """What pictures are undistorted with; None if there is none."""
        return self._calibration

    @property
    def camera(self) -> CameraModel | None:
        """The camera of the prepared frames, once the first has been seen."""
        return None if self._rectifier is None else self._rectifier.camera

    def __call__(self, frame: Frame) -> Frame:
        """The prepared frame.

        Raises:
            ConfigError: the crop, the calibration or the mask does not fit the picture.
            InputError: the picture cannot be tracked, or is of another size than the first.
        """
        check_picture(frame)
        height, width = frame.image.shape[:2]
        if self._rectifier is None:
            self._rectifier = self._plan(width, height)
            self._size = (width, height)
            if self._mask is not None and self._config.mask is not None:
                fitted = fit_mask(self._mask, self._config.mask, self._size, self._box)
                self._fitted_mask = self._rectifier.mask(fitted)
        if (width, height) != self._size:
            raise InputError(
                f"frame {frame.index} is {width} x {height}, the recording is "
                f"{self._size[0]} x {self._size[1]}; frames of one recording must be of one size"
            )
        x, y, w, h = self._box
        image = self._rectifier(np.ascontiguousarray(frame.image[y : y + h, x : x + w]))
        mask = frame.mask
        if mask is not None:
            mask = self._rectifier.mask(mask[y : y + h, x : x + w])
        if self._fitted_mask is not None:
            mask = self._fitted_mask if mask is None else self._fitted_mask & mask
        # The camera's own bytes are no longer those of this picture.
        camera = self._rectifier.camera
        return replace(frame, image=image, camera=camera, mask=mask, encoded=None)

    def _plan(self, width: int, height: int) -> Rectifier:
        self._box = crop_box(self._config.crop, width, height)
        camera = fit_calibration(self._calibration, (width, height), self._box)
        asked = self._config.width or min(DEFAULT_WIDTH_PX, camera.width)
        rectifier = Rectifier(camera, asked)
        size = (rectifier.camera.width, rectifier.camera.height)
        if min(size) < MIN_SIDE_PX:
            raise ConfigError(
                f"crop and width leave pictures of {size[0]} x {size[1]} pixels; tracking needs at "
                f"least {MIN_SIDE_PX} x {MIN_SIDE_PX}"
            )
        return rectifier


def check_picture(frame: Frame) -> None:
    """Refuse what no later stage can use.

    Raises:
        InputError: the picture is not 8-bit RGB, or is too small to be tracked.
    """
    image = frame.image
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise InputError(
            f"frame {frame.index} is {image.dtype} of shape {image.shape}; pictures must be 8-bit "
            "RGB, [height, width, 3]"
        )
    height, width = image.shape[:2]
    if min(height, width) < MIN_SIDE_PX:
        raise InputError(
            f"frame {frame.index} is {width} x {height} pixels; tracking needs pictures of at "
            f"least {MIN_SIDE_PX} x {MIN_SIDE_PX}"
        )


def crop_box(crop: str | None, width: int, height: int) -> Box:
    """(x, y, width, height) of a crop as a config has it; None keeps it all.

    Raises:
        ConfigError: it reaches outside the picture.
    """
    if crop is None:
        return (0, 0, width, height)
    if crop in {"left", "right"}:
        half = width // 2
        return (0 if crop == "left" else width - half, 0, half, height)
    x, y, w, h = crop_sides(crop)
    if x + w > width or y + h > height:
        raise ConfigError(f"crop '{crop}' reaches outside the {width} x {height} picture")
    return (x, y, w, h)


def fit_calibration(
    calibration: CameraModel | None, size: tuple[int, int], box: Box
) -> CameraModel:
    """The calibration for the cropped picture, whether it was made for the crop or the whole.

    Raises:
        ConfigError: its aspect ratio fits neither.
    """
    x, y, width, height = box
    if calibration is None:
        return guess_camera(width, height)
    if _same_shape(calibration, width, height):
        return calibration.resize(width, height)
    if _same_shape(calibration, *size):
        return calibration.resize(*size).crop(x, y, width, height)
    raise ConfigError(
        f"the calibration is for {calibration.width} x {calibration.height} pictures, these are "
        f"{width} x {height}; calibrate at this shape or choose the --crop that it was made for"
    )


def _same_shape(calibration: CameraModel, width: int, height: int) -> bool:
    ratio = (calibration.width * height) / (calibration.height * width)
    return abs(ratio - 1.0) < ASPECT_TOLERANCE


# --------------------------------------------------------------------------------------------------
# A mask given as a picture: white is used, black is not.

Mask = npt.NDArray[np.bool_]

WHITE = 128
"""Grey level from which a pixel of the mask is used."""
SOLID_SHARE = 0.02
"""Of the picture that a mask must leave: nothing can be tracked in less."""


def read_mask(path: Path) -> Mask:
    """[H, W] True where the pixel is used.

    Raises:
        ConfigError: it is no picture, or leaves nothing of one.
    """
    import cv2

    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise ConfigError(f"cannot read the mask {path}; give a PNG, white where it is used") from (
            error
        )
    grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if grey is None:
        raise ConfigError(f"the mask {path} is no picture; give a PNG, white where it is used")
    used = np.asarray(grey) >= WHITE
    if used.mean() < SOLID_SHARE:
        raise ConfigError(f"the mask {path} is nearly all black; white is what is used")
    return used


def fit_mask(
    mask: Mask,  # [H, W]
    path: Path,
    size: tuple[int, int],
    box: tuple[int, int, int, int],
) -> Mask:
    """The mask for the crop ``box`` (x, y, width, height), whether it was made for the crop or for
    the whole picture of ``size`` (width, height).

    Raises:
        ConfigError: it is of neither size.
    """
    x, y, w, h = box
    height, width = mask.shape
    if (width, height) == (w, h):
        return mask
    if (width, height) == size:
        return mask[y : y + h, x : x + w]
    raise ConfigError(
        f"the mask {path} is {width} x {height}, the pictures are {size[0]} x {size[1]}; make it "
        "of their size"
    )
