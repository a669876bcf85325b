"""What the evaluation reads of a dive's held-out views: pictures and their ranges."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, reason_of

Kind = Literal["real", "rendered", "restored"]
"""The picture of a view in ``heldout/``: the camera's, the map's, the one without water."""
Picture = npt.NDArray[np.uint8]
"""[H, W, 3] RGB."""


def held_out_indices(dive: Path, kind: Kind) -> list[int]:
    """Recording indices of the held-out frames that have such a picture, in order."""
    names = (path.name.partition("_")[0] for path in (dive / "heldout").glob(f"*_{kind}.png"))
    return sorted(int(name) for name in names if name.isdigit())


def read_picture(dive: Path, index: int, kind: Kind) -> tuple[Picture, npt.NDArray[np.bool_]]:
    """The picture, and where it shows something [H, W]: not where open water was removed.

    Raises:
        InputError: it cannot be read.
    """
    import cv2

    path = dive / "heldout" / f"{index:06d}_{kind}.png"
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.ndim != 3 or stored.dtype != np.uint8:
        raise InputError(f"cannot read the picture {path}; map the dive again")
    opaque = stored[..., 3] > 0 if stored.shape[2] == 4 else np.ones(stored.shape[:2], bool)
    return np.ascontiguousarray(stored[..., 2::-1]).astype(np.uint8, copy=False), opaque


def read_range(dive: Path, index: int) -> npt.NDArray[np.float32] | None:
    """[H, W] range of each pixel in the dive's unit, 0 where the map is not solid; None without a
    file.

    Raises:
        InputError: it cannot be read.
    """
    path = dive / "heldout" / f"{index:06d}_range.npz"
    if not path.is_file():
        return None
    try:
        with np.load(path) as stored:
            return np.asarray(stored["z"], np.float32)
    except Exception as error:  # zipfile, zlib and NumPy each raise their own
        raise InputError(
            f"cannot read the ranges {path}: {reason_of(error)}; map the dive again"
        ) from error


def read_restored_area(dive: Path, index: int) -> npt.NDArray[np.bool_] | None:
    """[H, W] where the restored picture was restored from the camera's, and is neither open water
    nor the vehicle; None without such a file.

    Raises:
        InputError: it cannot be read.
    """
    import cv2

    path = dive / "heldout" / f"{index:06d}_confidence.png"
    if not path.is_file():
        return None
    stored = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if stored is None:
        raise InputError(f"cannot read the picture {path}; map the dive again")
    return np.asarray(stored > 0)
