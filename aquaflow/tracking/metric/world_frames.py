"""Telemetry and known lengths of a dive, and the metric frames that they give."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors.failures import Failures
from aquaflow.config import FusionConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore
from aquaflow.telemetry.dead_reckoning import RecentMotion
from aquaflow.telemetry.start import camera_in_body
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frame_table import FrameTable
from aquaflow.tracking.graph.pose_graph import solve
from aquaflow.tracking.graph.table import GraphResult, Snapshot
from aquaflow.tracking.metric.measured import World
from aquaflow.tracking.metric.straightening import (
    LengthSightings,
    Straightened,
    TrackingSnapshot,
    estimates_of,
    sampled_points,
    straighten,
    straighten_again,
)
from aquaflow.types import TelemetrySample

Array = npt.NDArray[np.float64]

FEW_KEYFRAMES = 60
"""Up to which telemetry is asked whenever loops are closed."""
ASKED_AGAIN = 0.1
"""Share of the keyframes that have to be new since telemetry was last asked, beyond
``FEW_KEYFRAMES``: it answers for the whole dive, in 2 s of CPU time at 112 keyframes and more later
(notes/2026-11-speed.md#growth). Loops in between are closed with what it said."""


class EarlierDive(Protocol):
    """An earlier dive in which this one may be recognised (``tracking/base``)."""

    @property
    def recognised(self) -> bool:
        """True once this dive, or a part of it, has a place there."""
        ...

    def frame(self, sub_map: int, own: WorldFrame) -> WorldFrame:
        """The earlier dive's frame, or ``own`` where the sub-map was not recognised."""
        ...

    def worlds(self, snapshot: Snapshot) -> list[World]:
        """The earlier dive as a world of the components of the graph."""
        ...

    def follow_moves(self) -> None:
        """Keyframes have other poses or sub-maps than before."""
        ...


class WorldFrames:
    """Collects samples, sightings and points; a :class:`TrackingSnapshot` does the rest."""

    def __init__(
        self, keyframes: KeyframeStore, frames: Callable[[], FrameTable], config: FusionConfig,
        failures: Failures,
    ) -> None:  # fmt: skip
        self.telemetry = Telemetry()
        self._recent = RecentMotion()
        self.sightings = LengthSightings(config)
        """Objects of known size in the pictures."""
        self.mounting = config.camera
        """Of the camera in the body; a recording that states it may set it."""
        self.frames: dict[int, WorldFrame] = {}
        """By sub-map, as last estimated."""
        self._keyframes, self._frames, self._config = keyframes, frames, config
        self._failures = failures
        self._points: list[Array] = []
        self._since = 0
        self._solved: Straightened | None = None
        """Set in the thread of the last job."""
        self._asked = 0
        """Keyframes there were when telemetry was last asked; 0: it is to be asked anew."""
        self.strained = True
        """False if the last job left the keyframes where they would be without telemetry: another
        one would, too."""
        self.base: EarlierDive | None = None
        """An earlier dive in which this one may be recognised."""

    @property
    def present(self) -> bool:
        """True once there is telemetry, an object of known size was seen, or the dive was
        recognised in an earlier one."""
        recognised = self.base is not None and self.base.recognised
        return bool(self.telemetry) or bool(self.sightings) or recognised

    def add(self, sample: TelemetrySample) -> None:
        """A sample of telemetry, in the order of arrival."""
        if self._config.enabled:
            self.telemetry.add(sample)
            self._recent.add(sample)

    def motion(self, keyframe: Keyframe, first_ns: int, last_ns: int, before: Sim3) -> Sim3 | None:
        """The camera's motion between two frames by gyro and DVL, from the earlier to the later.

        None where they do not cover the time, or the camera's mounting is unknown. ``before``: the
        motion between the two frames before.
        """
        frame = self.of(keyframe.sub_map)
        T_bc = frame.T_bc or self._stated
        if T_bc is None:
            return None
        scale = frame.T_nm.scale * keyframe.T_wc.scale if frame.metric else None
        return motion_of_camera(self._recent, T_bc, scale, first_ns, last_ns, before)

    @property
    def _stated(self) -> Sim3 | None:
        """Camera to body as stated."""
        return None if self.mounting is None else camera_in_body(self.mounting)

    def keyframe(self, number: int, parent: int | None) -> bool:
        """A new keyframe; True if it is time to straighten the graph by telemetry."""
        if not self.present:
            return False
        if parent is not None:
            self._keep_points(parent)
        self._since += 1
        enough = ASKED_AGAIN * number if number > FEW_KEYFRAMES else 0.0
        if self._since < max(self._config.every_keyframes, enough):
            return False
        self._since, self._asked = 0, 0
        return True

    def ask_anew(self) -> None:
        """Let the next job ask telemetry, however lately that was done."""
        self._asked = 0

    def _keep_points(self, number: int) -> None:
        """A keyframe's depths are as good as they get once another one takes its place."""
        keyframe = self._keyframes[number]
        with self._failures.contain("depths of known lengths", keyframe.frame_index):
            self.sightings.keep_depths(keyframe.frame_index, lambda: keyframe.pointmap)
        if not self.telemetry:
            return
        while len(self._points) <= number:
            self._points.append(np.zeros((0, 3)))
        with self._failures.contain("points for the altimeter"):
            self._points[number] = sampled_points(keyframe.pointmap)

    def survey(self, snapshot: Snapshot) -> TrackingSnapshot:
        """All that is known now, for any thread."""
        parts, telemetry = self._frames().parts(), self.telemetry.copy()
        return TrackingSnapshot(
            snapshot.nodes, parts, telemetry, tuple(self._points), self.mounting, self._config,
            self.sightings.copy(),
        )  # fmt: skip

    def job(self, snapshot: Snapshot) -> Callable[[Snapshot], GraphResult]:
        """The optimisation of a snapshot together with telemetry, to be called in any thread."""
        count, before = len(snapshot.nodes), self._solved
        bases = [] if self.base is None else self.base.worlds(snapshot)
        lately = FEW_KEYFRAMES < count <= (1.0 + ASKED_AGAIN) * self._asked
        make: Callable[[Snapshot], Straightened]
        if lately and before is not None and before.fits(snapshot):
            make = partial(straighten_again, before=before, bases=bases)
        else:
            survey, self._asked = self.survey(snapshot), count
            t_s = {k.number: k.t_ns * 1e-9 for k in self._keyframes.keyframes}

            def ask(better: Snapshot) -> Straightened:
                return straighten(better, replace(survey, nodes=better.nodes), t_s, bases)

            make = ask

        def together(better: Snapshot) -> GraphResult:
            with self._failures.contain("telemetry in the keyframe graph"):
                self._solved = solved = make(better)
                self.strained = solved.strained
                return solved.result
            return solve(better)  # what telemetry cannot do must not cost the loops

        return together

    def apply(self) -> None:
        """The last job's result has been taken over by the keyframes."""
        if self.base is not None:
            self.base.follow_moves()
        if self._solved is not None:
            self._take(self._solved.frames)

    def update(self, snapshot: Snapshot) -> dict[int, WorldFrame]:
        """Estimate the frames of all sub-maps from their poses as they are now."""
        if len(snapshot.nodes) and self.present:
            self._keep_points(len(self._keyframes) - 1)
            with self._failures.contain("metric frames"):
                found = estimates_of(self.survey(snapshot))
                self._take({component: each.frame for component, each in found.items()})
        return self.frames

    def resume(self, snapshot: Snapshot) -> None:
        """Take up a restored dive, whose telemetry is there again."""
        for keyframe in self._keyframes.keyframes:
            if keyframe.number not in self._keyframes.lost:
                self._keep_points(keyframe.number)
        self.update(snapshot)

    def _take(self, frames: Mapping[int, WorldFrame]) -> None:
        self.frames = {
            self._keyframes[component].sub_map: frame for component, frame in frames.items()
        }

    def of(self, sub_map: int) -> WorldFrame:
        """The frame of a sub-map, as last estimated: that of an earlier dive where this one was
        recognised in it."""
        own = self.frames.get(sub_map, WorldFrame.unknown())
        return own if self.base is None else self.base.frame(sub_map, own)


# --------------------------------------------------------------------------------------------------
# The next frame's motion, as gyro and DVL have it, in the units of tracking.

LONGEST_S = 2.0
"""Between two frames of which the second is expected; a survey camera takes one a second."""


def motion_of_camera(
    recent: RecentMotion,
    T_bc: Sim3,
    metres_per_unit: float | None,
    first_ns: int,
    last_ns: int,
    before: Sim3,
) -> Sim3 | None:
    """T_c1c0 from the camera at the earlier moment to the camera at the later one.

    The turn is the gyro's; the translation is the DVL's where the scale is known, else that of
    ``before``, the motion between the two frames before. None where no gyro covers the time.

    Args:
        T_bc: camera to body, m.
        metres_per_unit: of the keyframe that poses are relative to; None while unknown.
    """
    first_s, last_s = first_ns * 1e-9, last_ns * 1e-9
    if not 0.0 < last_s - first_s <= LONGEST_S:
        return None
    R_b0b1 = recent.turn(first_s, last_s)
    if R_b0b1 is None:
        return None
    R_c0c1 = T_bc.R.T @ R_b0b1 @ T_bc.R
    moved = None if metres_per_unit is None else recent.displacement(first_s, last_s)
    if moved is None or metres_per_unit is None:
        away = -(before.R.T @ before.t)  # of the camera, in its earlier axes
    else:
        arm = (R_b0b1 - np.eye(3)) @ T_bc.t
        away = T_bc.R.T @ (moved + arm) / metres_per_unit
    return Sim3(R_c0c1.T, -(R_c0c1.T @ away))
