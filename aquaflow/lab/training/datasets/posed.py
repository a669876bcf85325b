"""What every data set is read into: posed pictures with depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.geometry.similarity import rotation_from_quaternion

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]

NED_TO_OPTICAL = np.array([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0],
                           [0.0, 0.0, 0.0, 1.0]])  # fmt: skip
"""Maps camera axes x right, y down, z forward into axes x forward, y right, z down."""


@dataclass(frozen=True)
class Posed:
    """One picture with all that is known of it."""

    image: Picture
    """[H, W, 3] RGB"""
    depth: Depth
    """[H, W] z, metres; 0 where unknown"""
    K: Array
    """[3, 3] px, the centre of the first pixel at (0.5, 0.5)"""
    T_wc: Array
    """[4, 4] camera to world, metres"""


class Sequence(Protocol):
    """Pictures of one scene in one world; neighbours in order are near each other."""

    @property
    def name(self) -> str:
        """Name for messages and figures."""
        ...

    @property
    def kind(self) -> str:
        """Data set that it is of."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Posed: ...


@dataclass(frozen=True)
class Frames:
    """A sequence whose frames are read when they are asked for."""

    name: str
    readers: tuple[Callable[[], Posed], ...]
    kind: str = ""

    def __len__(self) -> int:
        return len(self.readers)

    def __getitem__(self, index: int) -> Posed:
        return self.readers[index]()


def read_image(path: Path) -> Picture:
    """[H, W, 3] RGB, 8 bits.

    Raises:
        InputError: there is no such picture.
    """
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        raise InputError(f"cannot read the picture {path}; unpack the data set again")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def pose(
    position: npt.ArrayLike,  # [3]
    wxyz: npt.ArrayLike,  # [4]
) -> Array:
    """[4, 4] rotation of the quaternion and position."""
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion(np.asarray(wxyz, dtype=np.float64))
    T[:3, 3] = position
    return T


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Array:
    """[3, 3]"""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def table(path: Path, columns: int, delimiter: str | None = None) -> Array:
    """[N, columns] the numbers of a text table; lines that begin with # are left out.

    Raises:
        InputError: it cannot be read, or has other columns.
    """
    try:
        rows = np.loadtxt(path, delimiter=delimiter, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the table {path}; unpack the data set again") from error
    if rows.shape[1] < columns:
        raise InputError(f"{path} has {rows.shape[1]} columns, not {columns}; is it the right one?")
    return np.asarray(rows[:, :columns], dtype=np.float64)


def nothing_in(root: Path, expected: str) -> InputError:
    """The error of a folder that does not hold the data set."""
    return InputError(f"{root} holds no {expected}; give the folder that it was unpacked to")
