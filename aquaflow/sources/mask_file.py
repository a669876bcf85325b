"""A mask given as a picture: white is used, black is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import ConfigError

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
