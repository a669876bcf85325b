"""What leaves a dive, in n: the sub-maps' metric frames, computed once at the end of the dive."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

import numpy as np

from aquaflow.dive.held_out_example import HeldOut
from aquaflow.dive.results import WaterSummary
from aquaflow.telemetry.interpolation import Interpolation
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.utc import UtcClock, fit_utc
from aquaflow.telemetry.world_frame import WorldFrame
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
        """With its time zone; None where no source stated the time."""
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
        """Of a sub-map; the unknown one where there is none."""
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
    if not any(frame.metric or frame.level or frame.site for frame in frames.values()):
        return CAMERA_WORLD
    said = {number: _world_in_words(frame) for number, frame in frames.items()}
    if len(set(said.values())) == 1:
        return f"camera to world; {next(iter(said.values()))}"
    return "\n".join(f"camera to world; sub-map {number}: {each}" for number, each in said.items())


def _world_in_words(frame: WorldFrame) -> str:
    whose = f" of {frame.site}, in which this dive was recognised" if frame.site else ""
    axes = f"world is the first keyframe's camera (x right, y down, z forward){whose}"
    if frame.level:
        zero = "the water surface" if frame.depth_known else "the start"
        axes = f"world is n{whose}: x to {frame.north}, y to the right of it, z down from {zero}"
    return f"{axes}; unit: {frame.unit}"
