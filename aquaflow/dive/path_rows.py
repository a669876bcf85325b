"""The rows of trajectory.csv: each pose with what telemetry and the metric frame say of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from aquaflow.dive.georeference import to_geodetic
from aquaflow.dive.metric_outputs import MetricOutputs
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.geometry.similarity import BODY_FROM_CAMERA, Sim3
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frames import Tracked

Array = npt.NDArray[np.float64]

SPEED_SPAN_S = 0.5
"""Seconds over which a speed is taken: 1 mm of noise in a position gives 3 mm/s."""
LONGEST_SPAN_S = 5.0
"""Where pictures are rarer than this there is no speed."""


def path_rows(
    outputs: MetricOutputs,
    results: Sequence[Tracked],
    poses: Mapping[int, Sim3],  # T_nc by frame index
) -> list[PoseRow]:
    """A row for each pose, in the order of the recording."""
    posed = sorted(
        (tracked for tracked in results if tracked.frame.index in poses),
        key=lambda tracked: tracked.frame.index,
    )
    rows: dict[int, PoseRow] = {}
    for sub_map in sorted({tracked.sub_map for tracked in posed}):
        members = [tracked for tracked in posed if tracked.sub_map == sub_map]
        for row in _rows(outputs, sub_map, members, [poses[t.frame.index] for t in members]):
            rows[row.index] = row
    return [rows[tracked.frame.index] for tracked in posed]


def _rows(
    outputs: MetricOutputs, sub_map: int, members: list[Tracked], poses: list[Sim3]
) -> list[PoseRow]:
    """Of one sub-map."""
    frame, navigation = outputs.frame(sub_map), outputs.navigation
    positions = np.array([T.t for T in poses])
    t_s = np.array([tracked.frame.t_ns * 1e-9 for tracked in members])
    speeds = speeds_of(t_s, positions) if frame.metric else [None] * len(poses)
    places = _places(frame, positions)
    rows = []
    for tracked, T_nc, speed, (latitude, longitude) in zip(
        members, poses, speeds, places, strict=True
    ):
        t_ns = tracked.frame.t_ns
        x, y, z = (float(value) for value in T_nc.t)
        heading, roll, pitch = attitude_of(frame, T_nc)
        rows.append(
            PoseRow(
                tracked.frame.index, t_ns * 1e-9, navigation.utc_of(t_ns), sub_map,
                x, y, z, frame.unit, latitude, longitude,
                navigation.depth_m_at(t_ns), navigation.altitude_m_at(t_ns),
                heading, roll, pitch, speed,
                position_sigma(frame, T_nc.t), _heading_sigma_deg(frame),
            )
        )  # fmt: skip
    return rows


def _places(
    frame: WorldFrame,
    positions: Array,  # [N, 3] n
) -> list[tuple[float | None, float | None]]:
    """Latitude and longitude of each, degrees."""
    if not frame.georeferenced or frame.origin is None:
        return [(None, None)] * len(positions)
    latitudes, longitudes = to_geodetic(frame.origin, positions)
    return [(float(a), float(b)) for a, b in zip(latitudes, longitudes, strict=True)]


def attitude_of(
    frame: WorldFrame, T_nc: Sim3
) -> tuple[float, float, float] | tuple[None, None, None]:
    """Heading, roll and pitch, degrees, of the body, or of the camera if the mounting is unknown;
    none while gravity is unknown."""
    if not frame.level:
        return None, None, None
    R = T_nc.R @ (BODY_FROM_CAMERA if frame.T_bc is None else frame.T_bc.R).T
    heading = np.degrees(np.arctan2(R[1, 0], R[0, 0])) % 360.0
    pitch = np.degrees(np.arcsin(np.clip(-R[2, 0], -1.0, 1.0)))
    roll = np.degrees(np.arctan2(R[2, 1], R[2, 2]))
    return float(heading), float(roll), float(pitch)


def speeds_of(
    t_s: Array,  # [N] increasing
    positions: Array,  # [N, 3] m
) -> list[float | None]:
    """Of each pose: from the first to the last pose of the span around it, at least from the
    neighbour before to the one after."""
    number, last = np.arange(len(t_s)), len(t_s) - 1
    first = np.searchsorted(t_s, t_s - 0.5 * SPEED_SPAN_S)
    then = np.searchsorted(t_s, t_s + 0.5 * SPEED_SPAN_S, side="right") - 1
    first = np.maximum(np.minimum(first, number - 1), 0)
    then = np.minimum(np.maximum(then, number + 1), last)
    took = t_s[then] - t_s[first]
    moved = np.linalg.norm(positions[then] - positions[first], axis=1)
    return [
        float(m / s) if 0.0 < s <= LONGEST_SPAN_S else None
        for m, s in zip(moved, took, strict=True)
    ]


def position_sigma(
    frame: WorldFrame,
    p_n: Array,  # [3]
) -> float | None:
    """m, 1 sigma of a place in the direction that is known least; None where it is not known."""
    if not (frame.metric and frame.level):
        return None  # of a frame that is not level, no turn is known
    return float(np.sqrt(np.linalg.eigvalsh(frame.position_covariance(p_n))[-1]))


def _heading_sigma_deg(frame: WorldFrame) -> float | None:
    return float(np.degrees(frame.heading_sigma_rad)) if frame.level else None
