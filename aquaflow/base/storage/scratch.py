"""Arrays in files without a name, for what a command needs while it runs beyond its memory."""

from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError


def scratch_array(folder: Path, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """An array in a file of ``folder``, which is made if needed; the file ends with the array.

    Its room is taken at once: a disk that fills up later would end the process.

    Raises:
        InputError: the file cannot be made.
    """
    size = max(1, math.prod(shape)) * np.dtype(dtype).itemsize
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as stream:
            os.posix_fallocate(stream.fileno(), 0, size)
            flat: np.memmap[Any, Any] = np.memmap(
                stream, dtype, "r+", shape=(max(1, math.prod(shape)),)
            )
    except OSError as error:
        raise InputError(
            f"cannot write to {folder}: {error.strerror or error}; give a folder with room that "
            "can be written to"
        ) from error
    return flat[: math.prod(shape)].reshape(shape)
