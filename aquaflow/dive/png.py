"""Pictures as PNG files that are whole or not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.storage.atomic import atomic_write


def encoded_png(
    picture: npt.NDArray[np.uint8],  # [H, W] grey, [H, W, 3] RGB or [H, W, 4] RGBA
) -> bytes:
    """The content of a PNG file."""
    import cv2

    if picture.ndim == 3:
        to_bgr = cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
        picture = np.asarray(cv2.cvtColor(picture, to_bgr), dtype=np.uint8)
    _, encoded = cv2.imencode(".png", picture)
    return encoded.tobytes()


def write_png(
    path: Path,
    picture: npt.NDArray[np.uint8],  # [H, W] grey, [H, W, 3] RGB or [H, W, 4] RGBA
) -> None:
    """Write ``picture``.

    Raises:
        InputError: the file cannot be written.
    """
    content = encoded_png(picture)
    with atomic_write(path) as stream:
        stream.write(content)
