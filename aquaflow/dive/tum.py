"""Trajectories as TUM text, which every evaluation tool reads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import read_regular
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.geometry.similarity import (
    Sim3,
    quaternion_from_rotation,
    rotation_from_quaternion,
)

DECIMALS = 9
"""Nanoseconds, and nanometres at the scale of metres."""
ROW = " ".join([f"%.{DECIMALS}f"] * 8) + "\n"
"""Of the file: a fifth of what formatting each number by itself takes."""
ROWS_AT_ONCE = 256
"""Formatted without giving way to another thread: 1 ms."""


TUM_FIELDS = "t_s tx ty tz qx qy qz qw"
"""Columns of a TUM trajectory: s, position, quaternion with its real part last."""

QUATERNION_NORM_TOLERANCE = 0.01
"""Quaternions are normalised when read; further from 1 than this, the columns are mixed up."""


ASSOCIATION_TOLERANCE_S = 0.01
"""Two poses are of the same moment if their times differ by less: one centimetre at 1 m/s."""


@dataclass(frozen=True)
class Trajectory:
    """Camera poses ``T_wc`` over time, times strictly increasing."""

    t_s: npt.NDArray[np.float64]
    """[N] s."""
    positions: npt.NDArray[np.float64]
    """[N, 3] camera centre in the world, in the file's unit."""
    wxyz: npt.NDArray[np.float64]
    """[N, 4] unit quaternions, world from camera."""

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def R_wc(self) -> npt.NDArray[np.float64]:
        """[N, 3, 3] rotations, world from camera."""
        return rotation_from_quaternion(self.wxyz)

    @property
    def path_length(self) -> float:
        """Sum of the distances between successive positions, in the file's unit."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def select(
        self,
        chosen: npt.NDArray[np.intp] | npt.NDArray[np.bool_],  # [K] indices or [N] mask
    ) -> Trajectory:
        """The poses at ``chosen`` (indices or a mask)."""
        return Trajectory(self.t_s[chosen], self.positions[chosen], self.wxyz[chosen])

    def transform(self, T: Sim3) -> Trajectory:
        """The same poses in the frame that ``T`` maps to."""
        return Trajectory(
            self.t_s, T.apply(self.positions), quaternion_from_rotation(T.R @ self.R_wc)
        )


def read_tum(path: Path, inside: bool = False) -> Trajectory:
    """Read ``t_s tx ty tz qx qy qz qw`` lines; lines that start with # are comments.
    ``inside``: of a folder that others may have made.

    Raises:
        InputError: the file cannot be read, a line is malformed, or no pose is left.
    """
    try:
        data = read_regular(path) if inside else path.read_bytes()
        lines = data.decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot read the trajectory {path}: {reason_of(error)}; give a TUM text file"
        ) from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        row = _parse(text, path, number)
        if rows and row[0] <= rows[-1][0]:
            raise InputError(
                f"{path} line {number}: time {row[0]:g} s does not come after {rows[-1][0]:g} s; "
                "sort the poses by time and keep one for each moment"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{path} holds no pose; expected lines of '{TUM_FIELDS}'")
    table = np.array(rows, dtype=np.float64)
    wxyz = table[:, [7, 4, 5, 6]]
    return Trajectory(
        table[:, 0], table[:, 1:4], wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    )


def _parse(text: str, path: Path, number: int) -> list[float]:
    """Eight finite numbers with a unit quaternion, or a sentence with the fault."""
    fields = text.replace(",", " ").split()
    if len(fields) != len(TUM_FIELDS.split()):
        raise InputError(
            f"{path} line {number}: expected the 8 numbers '{TUM_FIELDS}', found {len(fields)}"
        )
    try:
        row = [float(field) for field in fields]
    except ValueError as error:
        raise InputError(
            f"{path} line {number}: these are not 8 numbers; expected '{TUM_FIELDS}'"
        ) from error
    if not np.isfinite(row).all():
        raise InputError(f"{path} line {number}: a number is not finite; remove this pose")
    norm = float(np.linalg.norm(row[4:]))
    if abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise InputError(
            f"{path} line {number}: the quaternion's length is {norm:.3g} instead of 1; "
            f"check the order of the columns: '{TUM_FIELDS}'"
        )
    return row


def write_tum(
    path: Path,
    t_s: npt.NDArray[np.floating],  # [N] s
    positions: npt.NDArray[np.floating],  # [N, 3] world
    wxyz: npt.NDArray[np.floating],  # [N, 4] world from camera
    comment: str = "",
) -> None:
    """Write ``t_s tx ty tz qx qy qz qw`` lines atomically; the same poses give the same bytes.

    Quaternions are normalised and written with w >= 0, as q and -q are one rotation.

    Raises:
        InputError: the file cannot be written.
        ArithmeticError: a pose is not finite.
    """
    unit = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    unit = np.where(unit[:, :1] < 0.0, -unit, unit)
    table = np.column_stack([t_s, positions, unit[:, [1, 2, 3, 0]]]).astype(np.float64)
    # Rounding before adding zero turns -0.0 and what rounds to it into 0.0.
    table = np.round(table, DECIMALS) + 0.0
    if not np.isfinite(table).all():
        raise ArithmeticError("a pose is not finite")
    lines = [f"# {line}" for line in comment.splitlines()]
    lines.append("# t_s tx ty tz qx qy qz qw, camera to world")
    with atomic_write(path) as stream:
        stream.write(("\n".join(lines) + "\n").encode("utf-8"))
        for first in range(0, len(table), ROWS_AT_ONCE):
            rows = table[first : first + ROWS_AT_ONCE]
            stream.write(((ROW * len(rows)) % tuple(rows.ravel().tolist())).encode("utf-8"))


def associate(
    first_s: npt.NDArray[np.float64],  # [N] s, increasing
    second_s: npt.NDArray[np.float64],  # [M] s, increasing
    tolerance_s: float = ASSOCIATION_TOLERANCE_S,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Indices [K] into both lists of the times that are each other's nearest, within tolerance."""
    if len(first_s) == 0 or len(second_s) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    to_second = _nearest(first_s, second_s)
    to_first = _nearest(second_s, first_s)
    first = np.arange(len(first_s))
    mutual = to_first[to_second] == first
    close = np.abs(second_s[to_second] - first_s) <= tolerance_s
    kept = np.flatnonzero(mutual & close)
    return kept, to_second[kept]


def _nearest(
    of: npt.NDArray[np.float64],  # [N] s
    among: npt.NDArray[np.float64],  # [M] s, increasing
) -> npt.NDArray[np.intp]:
    """Indices [N] into ``among`` [M] of the times nearest to ``of`` [N], the earlier on a tie."""
    after = np.clip(np.searchsorted(among, of), 1, max(len(among) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(among) - 1)
    return np.where(of - among[before] <= among[after] - of, before, after)
