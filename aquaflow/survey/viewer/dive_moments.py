"""The moments of a finished dive's poses, from trajectory.csv, and the pictures that it keeps."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import HELD_OUT, Dive
from aquaflow.dive.trajectory_csv import NAME as PATH_TABLE
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.recordings.kept_pictures import kept_pictures
from aquaflow.survey.viewer.moments import Float, moments

log = logging.getLogger(__name__)


def pictures_of_dive(dive: Dive) -> dict[int, Path]:
    """What the camera saw, by the frame's index: the held-out pictures and the small ones."""
    found = kept_pictures(dive.path)
    for path in dive.file(HELD_OUT).glob("*_real.png"):
        number = path.name.removesuffix("_real.png")
        if path.is_symlink() or path.parent.is_symlink():
            continue
        if number.isascii() and number.isdecimal():
            found[int(number)] = path
    return found


def moments_of_dive(
    dive: Dive,
    t_s: npt.NDArray[np.float64],  # [N] of the poses in trajectory.tum
    index: npt.NDArray[np.int64],  # [N] of their frames, -1 where not known
    kept: Iterable[int],
) -> tuple[Float, datetime | None]:
    """[N, 5] as :func:`aquaflow.survey.viewer.moments.moments` gives them, and the UTC of the
    first pose, if it is known."""
    table = _table(dive)
    rows = [table.get(round(float(each) * 1e6)) for each in t_s]
    depth = np.array([_or_nan(row.depth_m if row else None) for row in rows], np.float64)
    heading = np.array([_or_nan(row.heading_deg if row else None) for row in rows], np.float64)
    began = None
    for row in rows:
        if row is not None and row.utc is not None:
            began = row.utc - timedelta(seconds=row.t_s - float(t_s[0]))
            break
    return moments(t_s, depth, heading, index, kept), began


def _table(dive: Dive) -> dict[int, PoseRow]:
    """By microsecond; nothing where there is no such file, or one of another version."""
    if not dive.has(PATH_TABLE):
        return {}
    try:
        return {round(row.t_s * 1e6): row for row in dive.poses}
    except InputError as error:
        log.warning("the viewer shows neither depth nor heading: %s", error)
        return {}


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value
