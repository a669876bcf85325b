"""What leaves a dive, in n: its sub-maps' metric frames, and the rows of trajectory.csv."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.dive.held_out_example import HeldOut
from aquaflow.dive.placement import to_geodetic
from aquaflow.dive.results import WaterSummary
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.geometry.similarity import BODY_FROM_CAMERA, Sim3
from aquaflow.telemetry.camera_path import Interpolation
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.utc import UtcClock, fit_utc
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frames import Tracked
from aquaflow.types import Altitude, Depth

CAMERA_WORLD = (
    "camera to world; world is the first keyframe's camera (x right, y down, z forward); scale: "
    "see scale_source in metrics.json"
)
"""First line of trajectory.tum where neither metres nor gravity are known."""


def _nothing(_: int) -> None:
    return None


@dataclass(frozen=True)
class Navigation:
    """What the vehicle measured at the moment of a frame, by its ``t_ns``; None: nothing."""

    clock: UtcClock | None = None
    depth_m_at: Callable[[int], float | None] = _nothing
    altitude_m_at: Callable[[int], float | None] = _nothing

    def utc_of(self, t_ns: int) -> datetime | None:
        """Moment in UTC, with its time zone; None where no source stated the time."""
        return None if self.clock is None else self.clock.utc_of(t_ns)

    @staticmethod
    def of(telemetry: Telemetry) -> Navigation:
        """What is in the telemetry of a dive, on the clock of its frames."""
        return Navigation(
            fit_utc(telemetry.utc),
            depth_m_at=Interpolation.of(telemetry.of(Depth)).at,
            altitude_m_at=Interpolation.of(telemetry.of(Altitude)).at,
        )


@dataclass(frozen=True)
class MetricOutputs:
    """The frames of all sub-maps, and what else telemetry says of the poses."""

    frames: Mapping[int, WorldFrame] = field(default_factory=dict)
    """By sub-map."""
    navigation: Navigation = Navigation()

    def frame(self, sub_map: int) -> WorldFrame:
        """The metric frame of a sub-map; the unknown one where there is none."""
        return self.frames.get(sub_map, WorldFrame.unknown())


def water_in(water: WaterSummary, scale: float) -> WaterSummary:
    """The water with rates and ranges in another unit, ``scale`` of which are a map unit."""
    if scale == 1.0:
        return water
    return replace(
        water,
        beta_a=[rate / scale for rate in water.beta_a],
        b=[rate / scale for rate in water.b],
        d=[rate / scale for rate in water.d],
        range_p5=water.range_p5 * scale,
        range_median=water.range_median * scale,
        range_p95=water.range_p95 * scale,
        near_range=None if water.near_range is None else water.near_range * scale,
        lamp=water.lamp and water.lamp.rescale(scale),
    )


def held_out_in(example: HeldOut, scale: float) -> HeldOut:
    """The held-out view with its ranges in another unit, ``scale`` of which are a map unit."""
    if scale == 1.0 or example.z is None:
        return example
    return replace(example, z=(scale * example.z.astype(np.float64)).astype(np.float32))


def frame_numbers(frame: WorldFrame) -> dict[str, Any]:
    """The keys of metrics.json on the unit of length, gravity and telemetry."""
    return {
        "scale_source": frame.scale_source,
        "scale_sigma": frame.scale_sigma if frame.metric else None,
        "unit": frame.unit,
        "north": frame.north,
        "gravity_sigma_deg": float(np.degrees(frame.tilt_sigma_rad)) if frame.level else None,
        "telemetry": [
            {"source": s.source, "kind": s.kind, "used": s.used, "rejected": s.rejected,
             "reason": s.reason}
            for s in frame.sources
        ],
    }  # fmt: skip


def metric_frame_numbers(frame: WorldFrame) -> dict[str, Any]:
    """For who looks on: what is known of scale, gravity and north, and why sources are not used."""
    return {
        "metric": frame.metric,
        "metres_per_map_unit": round(frame.T_nm.scale, 5) if frame.metric else None,
        "scale_sigma": round(frame.scale_sigma, 5) if frame.metric else None,
        "scale_source": frame.scale_source,
        "clock_offset_s": round(frame.clock_offset_s, 3),
        "level": frame.level,
        "gravity_sigma_deg": (
            round(float(np.degrees(frame.tilt_sigma_rad)), 3) if frame.level else None
        ),
        "north": frame.north,
        "sources": {
            f"{source.source} {source.kind}": {
                "used": source.used, "rejected": source.rejected, "reason": source.reason,
            }
            for source in frame.sources
        },
    }  # fmt: skip


def utc_numbers(navigation: Navigation) -> dict[str, Any]:
    """The keys of metrics.json on UTC, null where no source stated it."""
    clock = navigation.clock
    start = None if clock is None else clock.utc_of(0).isoformat().replace("+00:00", "Z")
    return {
        "utc_start": start,
        "utc_source": None if clock is None else clock.source,
        "utc_sigma_s": None if clock is None else clock.sigma_at_s(0),
    }


def sub_maps_in_words(frames: list[WorldFrame]) -> str:
    """How the sub-maps of a dive, of which there are several, lie to one another."""
    count = len(frames)
    if all(frame.metric and frame.level for frame in frames):
        return f"{count} sub-maps, all in metres and level; trajectory.csv has the sigma of each"
    if all(frame.metric for frame in frames):
        return f"{count} sub-maps, all in metres; how they lie to one another is not known"
    return f"{count} sub-maps without a common scale"


def worlds_in_words(frames: Mapping[int, WorldFrame]) -> str:
    """The worlds of the sub-maps, for the first lines of trajectory.tum."""
    if not any(frame.metric or frame.has_vertical or frame.site for frame in frames.values()):
        return CAMERA_WORLD
    said = {number: _world_in_words(frame) for number, frame in frames.items()}
    if len(set(said.values())) == 1:
        return f"camera to world; {next(iter(said.values()))}"
    return "\n".join(f"camera to world; sub-map {number}: {each}" for number, each in said.items())


def _world_in_words(frame: WorldFrame) -> str:
    whose = f" of {frame.site}, in which this dive was recognised" if frame.site else ""
    axes = f"world is the first keyframe's camera (x right, y down, z forward){whose}"
    if frame.has_vertical:
        axes = f"world is n{whose}: {frame.axes}"
    if frame.level:
        axes += f" from {'the water surface' if frame.depth_known else 'the start'}"
    return f"{axes}; unit: {frame.unit}"


# --------------------------------------------------------------------------------------------------
# The rows of trajectory.csv: each pose with what telemetry and the metric frame say of it.

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
                position_sigma(frame, T_nc.t), heading_sigma_deg(frame),
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
    """Speed of each pose: from the first to the last pose of the span around it, at least from the
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
    if not (frame.metric and frame.has_heading):
        return None  # no turn is known
    return float(np.sqrt(np.linalg.eigvalsh(frame.position_covariance(p_n))[-1]))


def heading_sigma_deg(frame: WorldFrame) -> float | None:
    """1 sigma of the heading of n; None where nothing says which way x points."""
    return float(np.degrees(frame.heading_sigma_rad)) if frame.has_heading else None
