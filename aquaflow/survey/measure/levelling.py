"""The vertical of a finished dive that no telemetry measured: from points on something level, or
from how far below the horizon its cameras look."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.base.storage.dive_status import refuse_unfinished
from aquaflow.dive.dive import MAP, METRICS, Dive
from aquaflow.survey.export.ortho.ground import NO_OVERVIEW, OVERVIEW
from aquaflow.survey.measure.asked import Asked
from aquaflow.survey.measure.points import MeasuredPoints
from aquaflow.survey.measure.reframing import (
    Progress,
    level,
    measure_anew,
    reframe,
    why_not_level,
)
from aquaflow.telemetry.world_frame import GRAVITY, LARGEST_TILT_SIGMA, SourceReport

Array = npt.NDArray[np.float64]

LEVEL_SIGMA_DEG = 2.0
"""1 sigma of how level the points' plane is, and of the cameras' mean pitch, unless stated:
judgement; a tank's floor is better, a sandy bottom worse."""
LEAST_POINTS = 3
"""Of a plane."""
ONE_LINE = 0.02
"""Width of the points over their length below which they lie on a line, and tip about it."""
LEAST_AHEAD = 0.5
"""Horizontal part of the first camera's axis from which it is the initial heading; a camera that
looks down more steeply, by 60 degrees, has the top of its picture for one."""


@dataclass(frozen=True)
class Vertical:
    """Which way is down in a dive, and how well that is known."""

    down: Array
    """[3] unit, in n."""
    covariance: Array
    """[3, 3] rad^2 of ``down``, in n; of rank two."""
    report: SourceReport

    @property
    def sigma_deg(self) -> float:
        """1 sigma in the direction that is known least."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1])))

    def in_words(self) -> str:
        """How well it is known."""
        return f"The vertical is known to {self.sigma_deg:.2g} degrees (1 sigma)."


def of_points(dive: Dive, asked: list[Asked], sigma_deg: float = LEVEL_SIGMA_DEG) -> Vertical:
    """The vertical by three points at least of the largest sub-map, which lie on something level:
    the water surface, a tank's floor, a plate.

    Which side of it is up follows from the cameras, whose pictures have up on top, or look down.

    Args:
        sigma_deg: 1 sigma of how level it is.

    Raises:
        InputError: the dive has no map, a point is not in it, or the points give no plane.
        ConfigError: the dive's settings cannot be read.
    """
    if len(asked) < LEAST_POINTS:
        raise InputError(f"a plane needs {LEAST_POINTS} points, not {len(asked)}; give more")
    from aquaflow.survey.measure.answers import width_seen  # loads torch
    from aquaflow.survey.measure.asked import locate

    mapper, frame = dive.filled_map(), dive.frame
    points = locate(asked, mapper, frame, dive, None, None, width_seen(mapper, frame))
    return plane_of(points, _rotations(dive), sigma_deg)


def plane_of(
    points: MeasuredPoints,
    cameras: Array,  # [M, 3, 3] R_nc
    sigma_deg: float,
) -> Vertical:
    """The vertical across the plane of ``points``, by generalised least squares.

    Raises:
        InputError: the points lie on a line.
    """
    count = len(points.places)
    offset = points.places - points.places.mean(axis=0)
    _, (length, width, _), axes = np.linalg.svd(offset, full_matrices=False)
    if width < ONE_LINE * length:
        raise InputError("the points lie on one line; mark others, beside it")
    up = axes[2]
    # Cameras look ahead or down, with up on top: both together, as for pitches of -45 to 135.
    up = up * np.sign((-cameras[:, :, 1] - cameras[:, :, 2]).mean(axis=0) @ up)
    C = np.einsum("iajb,a,b->ij", points.covariance().reshape(count, 3, count, 3), up, up)
    J = np.column_stack([offset @ axes[0], offset @ axes[1], np.ones(count)])
    weighted = np.linalg.solve(C, J)
    of_slopes = np.linalg.inv(J.T @ weighted)
    slopes = of_slopes @ (weighted.T @ (offset @ up))
    left = offset @ up - J @ slopes
    if count > LEAST_POINTS:
        of_slopes *= max(1.0, float(left @ np.linalg.solve(C, left)) / (count - LEAST_POINTS))
    down = slopes[0] * axes[0] + slopes[1] * axes[1] - up
    down /= np.linalg.norm(down)
    level_too = math.radians(sigma_deg) ** 2 * np.eye(2)
    covariance = axes[:2].T @ (of_slopes[:2, :2] + level_too) @ axes[:2]
    return Vertical(down, covariance, SourceReport("points on a level plane", GRAVITY, count))


def of_pitch(dive: Dive, pitch_deg: float, sigma_deg: float = LEVEL_SIGMA_DEG) -> Vertical:
    """The vertical by the mean pitch of the largest sub-map's cameras, which roll to neither side
    in the mean.

    Args:
        pitch_deg: of the optical axis below the horizon; 90 looks straight down.
        sigma_deg: 1 sigma of it, and of the roll.

    Raises:
        InputError: the dive has no path, or its cameras look in all directions.
    """
    pitch = math.radians(pitch_deg)
    cameras = _rotations(dive)
    # What is down to a camera of that pitch: its picture's lower edge, or ahead of it.
    down = (math.sin(pitch) * cameras[:, :, 2] + math.cos(pitch) * cameras[:, :, 1]).mean(axis=0)
    length = float(np.linalg.norm(down))
    if length < LEAST_AHEAD:
        raise InputError(f"the cameras of {dive} turn over; mark points on something level instead")
    down /= length
    across = np.eye(3) - np.outer(down, down)
    named = f"cameras {pitch_deg:g} degrees below the horizon"
    report = SourceReport(named, GRAVITY, len(cameras))
    return Vertical(down, math.radians(sigma_deg) ** 2 * across, report)


def _rotations(dive: Dive) -> Array:
    """[M, 3, 3] R_nc of the largest sub-map's poses, in time."""
    found: Array = dive.trajectory.R_wc[dive.sub_map_of_pose == dive.main]
    if len(found) == 0:
        raise InputError(f"{dive} has no pose; map a recording that shows more")
    return found


def make_level(
    folder: Path, find: Callable[[Dive], Vertical], progress: Progress | None = None
) -> Vertical:
    """Turn the files of a finished dive until z points down, and draw and measure its ground anew.

    Args:
        find: the vertical of the dive, as by :func:`of_points` or :func:`of_pitch`.

    Raises:
        InputError: the dive is not finished, telemetry has measured gravity, the vertical is not
            known well enough, or a file cannot be read or written.
        ConfigError: the dive's settings cannot be read.
    """
    refuse_unfinished(folder)
    dive = Dive(folder)
    frame = dive.metric_frames.get(dive.main)
    why = why_not_level(frame)
    if frame is None or why is not None:
        raise InputError(f"{folder} stays as it is: {why}")
    found = find(dive)
    if found.sigma_deg > np.degrees(LARGEST_TILT_SIGMA):
        raise InputError(
            f"this gives the vertical to {found.sigma_deg:.1f} degrees (1 sigma) alone, which is "
            f"more than {np.degrees(LARGEST_TILT_SIGMA):.0f}; mark more points, farther apart, or "
            "state a better --sigma"
        )
    R_ln = _upright(found.down, _rotations(dive)[0])
    of_down = (R_ln @ found.covariance @ R_ln.T)[:2, :2]
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])  # w x (0, 0, 1) = (w_y, -w_x, 0)
    reframe(dive, dive.main, level(frame, R_ln, turn @ of_down @ turn.T, found.report))
    _draw_anew(Dive(folder))
    measure_anew(folder, progress)
    return found


def _upright(
    down: Array,  # [3] unit, in n
    R_nc: Array,  # [3, 3] of the first camera
) -> Array:
    """[3, 3] from n to the level n, whose x is the initial heading."""
    ahead = R_nc[:, 2] - down * (down @ R_nc[:, 2])
    if np.linalg.norm(ahead) < LEAST_AHEAD:
        ahead = -R_nc[:, 1] + down * (down @ R_nc[:, 1])
    x = ahead / np.linalg.norm(ahead)
    return np.array([x, np.cross(down, x), down])


def _draw_anew(dive: Dive) -> None:
    """The dive's map from above, without the note that there is none."""
    if not dive.has(MAP):
        return
    from aquaflow.survey.export.ortho.survey import overview_png  # loads torch

    picture = overview_png(dive.filled_map(), dive.frame)
    with atomic_write(dive.file(OVERVIEW)) as stream:
        stream.write(picture)
    notes = [each for each in dive.metrics.get("notes", []) if not each.startswith(NO_OVERVIEW)]
    write_json(dive.file(METRICS), dive.metrics | {"notes": notes})
