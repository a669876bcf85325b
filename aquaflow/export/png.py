"""Pictures as PNG files that are whole or not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.storage.atomic import atomic_write


def write_png(
    path: Path,
    picture: npt.NDArray[np.uint8],  # [H, W, 3] RGB
) -> None:
    """Write ``picture``.

    Raises:
        InputError: the file cannot be written.
    """
    import cv2

    _, encoded = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    with atomic_write(path) as stream:
        stream.write(encoded.tobytes())
