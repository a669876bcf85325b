"""The files at the end of a dive; each part is computed and written separately.

A part that fails is counted and made once more; one that fails again is named in the notes and left
out, and never costs another. Where it was the maps' device that failed, they go on on the CPU, and
the part is made there.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import IntEnum
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors import InputError
from aquaflow.config.white_balance import DAYLIGHT
from aquaflow.dive.calibration_pass import FoundCamera
from aquaflow.dive.dive import Dive
from aquaflow.dive.fixes_csv import fix_rows
from aquaflow.dive.folder import IN_SITE, DiveFolder
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.dive.held_out_example import HeldOut, mean_amplification
from aquaflow.dive.metric_outputs import (
    MetricOutputs,
    held_out_in,
    path_rows,
    water_in,
    worlds_in_words,
)
from aquaflow.dive.placement import GEOREFERENCE, georeference, in_site
from aquaflow.dive.results import (
    WaterSummary,
    largest_sub_map,
    medium_json,
    refined_poses,
    tracked_poses,
)
from aquaflow.dive.trajectory_csv import NAME as TRAJECTORY_CSV
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore
from aquaflow.keyframes.place import (
    EDGE,
    NAME,
    KeyframePlace,
    KeypointDepths,
    Rows,
    depths_at,
    write_places,
)
from aquaflow.slam import Slam
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frames import Tracked
from aquaflow.tracking.graph.table import Snapshot
from aquaflow.types import CameraModel

T = TypeVar("T")


class Deliverables:
    """Evaluates a finished dive and writes its files into the dive folder: those of the core, and
    by :meth:`make` the others."""

    def __init__(
        self,
        name: str,
        folder: DiveFolder,
        slam: Slam,
        results: list[Tracked],
        calibration: CameraModel | None,
        outputs: MetricOutputs | None = None,
        found: FoundCamera | None = None,
        others: Mapping[str, Deliverable] | None = None,
    ) -> None:
        """``results``: all frames with their final poses; ``calibration``: as given, if any, else
        ``found`` may be there; ``outputs``: None where nothing but the map is known; ``others``:
        as :func:`aquaflow.dive.deliverables.deliverables_of` gives them."""
        self.name, self.folder, self.slam = name, folder, slam
        self.results, self.calibration, self._found = results, calibration, found
        self._others = others or {}
        self.outputs = outputs or MetricOutputs()
        self.held_out: list[HeldOut] = []
        """Ranges in the unit of the largest sub-map's metric frame."""
        self.notes: list[str] = []
        """What was left out."""
        self._poses_m = tracked_poses(results)
        """T_mc by frame index."""
        self.poses: dict[int, Sim3] = self._in_n(self._poses_m)
        """T_nc by frame index."""
        self._main = largest_sub_map(results)
        self._waters: dict[int, WaterSummary | None] = {}
        """By sub-map, in map units; a sub-map whose summary failed is missing."""
        self._rows: list[PoseRow] | None = None

    def _attempt(self, stage: str, work: Callable[[], T]) -> T | None:
        failures = self.slam.failures
        before = failures.of_device
        made = failures.attempt(stage, work)
        # A part may have contained the failure itself, and be there without what it cost.
        if failures.of_device > before and self.slam.maps.leave_device(f"in {stage}"):
            made = failures.attempt(stage, work)
        return made

    @property
    def metric_frame(self) -> WorldFrame:
        """The metric frame of the largest sub-map."""
        return self.outputs.frame(self._main)

    def _in_n(self, poses: dict[int, Sim3]) -> dict[int, Sim3]:
        sub_maps = {tracked.frame.index: tracked.sub_map for tracked in self.results}
        return {index: self.outputs.frame(sub_maps[index]).pose(T) for index, T in poses.items()}

    def summarise(self) -> None:
        """Poses as the map refined them, the vertical and the water of each sub-map."""
        attempt = self._attempt
        for mapper in self.slam.mappers.values():
            mapper.scene.finish()
        for sub_map in self.slam.mappers:
            attempt("the ground's plane", partial(self._find_ground, sub_map))
        refined = attempt("refined poses", lambda: refined_poses(self.slam, self.results))
        self._poses_m = refined or self._poses_m
        self.poses = self._in_n(self._poses_m)
        for sub_map in self.slam.mappers:
            attempt("water summary", partial(self._summarise_water, sub_map))

    def _find_ground(self, sub_map: int) -> None:
        from aquaflow.dive.shown_views import on_ground  # loads torch

        frame = on_ground(self.outputs.frame(sub_map), self.slam.mappers[sub_map])
        self.outputs = replace(self.outputs, frames={**self.outputs.frames, sub_map: frame})

    def _summarise_water(self, sub_map: int) -> None:
        from aquaflow.dive.map_file import summarise_water  # loads torch
        from aquaflow.dive.white_balance import place_in_daylight

        mapper = self.slam.mappers[sub_map]
        if mapper.config.medium.white_balance.startswith(DAYLIGHT):
            note = place_in_daylight(mapper, self._path_rows(), sub_map)
            self.notes += [note] if note is not None and sub_map == self._main else []
        self._waters[sub_map] = summarise_water(mapper)

    def _examine(self, until: Deadline | None) -> list[HeldOut]:
        if self._main not in self.slam.mappers:
            return []
        from aquaflow.dive.held_out import examine_held_out  # loads torch

        return examine_held_out(self.slam, self._main, self._poses_m, until)

    def evaluate(self, until: Deadline | None = None) -> None:
        """Held-out views, as many as there is time for."""
        main = self._main
        found = self._attempt("evaluation", partial(self._examine, until)) or []
        scale = self.metric_frame.T_nm.scale
        self.held_out = [held_out_in(example, scale) for example in found]
        there = len(self.slam.held_out.get(main, ()))
        if until is not None and until.over and len(found) < there:
            self.notes.append(
                f"{there - len(found)} of {there} held-out views were not evaluated: the dive's "
                "end had no more time (service.finish_s)"
            )

    def make(
        self,
        phase: DeliverablePhase,
        until: Deadline | None = None,
        metrics: dict[str, Any] | None = None,
    ) -> None:
        """The deliverables of other floors that belong to ``phase``; ``metrics``: the content of
        metrics.json with the notes, as far as it is known."""

        def work(each: Deliverable) -> None:
            each.make(self.dive(metrics or {}), until or Deadline(None))

        for each in self._others.values():
            if each.phase is phase:
                each.notes = []
                self._attempt(each.stage, partial(work, each))
                self.notes += each.notes

    def dive(self, metrics: dict[str, Any]) -> Dive:
        """What is known by now, as who reads the folder later will see it."""
        known: dict[str, Any] = {
            "name": self.name,
            "config": self.slam.config,
            "is_calibrated": self.calibration is not None,
            "metrics": metrics,
            "metric_frames": self.outputs.frames,
            "main": self._main,
            "medium_facts": self._medium_facts(),
            "attenuations": self._attenuations(),
            "maps": self.slam.mappers,
            "held_out": self.held_out,
        }
        if self._rows is not None:
            known["poses"] = self._rows
        if self.slam.tracker.camera is not None:
            known["camera"] = self.slam.tracker.camera
        return Dive(self.folder.path, **known)

    def _attenuations(self) -> dict[int, Sequence[float]]:
        return {n: water.beta_a for n, water in self._waters.items() if water is not None}

    def _path_rows(self) -> list[PoseRow]:
        if self._rows is None:
            self._rows = path_rows(self.outputs, self.results, self.poses)
        return self._rows

    def write(self) -> None:
        """Trajectory, cameras and maps: what does not wait for an evaluation."""
        attempt = self._attempt
        attempt("writing trajectory.tum", self._write_trajectory)
        attempt("writing trajectory.csv", self._write_path_table)
        attempt("writing fixes.csv", self._write_fixes)
        attempt("writing metric.json", self._write_metric_file)
        attempt("writing georeference.json", self._write_georeference)
        attempt(f"writing {IN_SITE}", self._write_in_site)
        camera = self.slam.tracker.camera
        if camera is not None:
            attempt("writing camera.yaml", partial(self._write_cameras, camera))
        for sub_map in self.slam.mappers:
            self._write_map(sub_map)
        places = partial(write_places_of, self.folder.path, self.slam, self._poses_m)
        attempt("writing places.npz", places)

    def write_evaluation(self) -> None:
        """The held-out views, and the water with what they say of it."""
        attempt = self._attempt
        attempt("writing held-out views", partial(self.folder.write_held_out, self.held_out))
        if self._is_water_known:
            attempt("writing medium.json", self._write_medium)

    def _write_cameras(self, mapped: CameraModel) -> None:
        """With the calibration that was given, or found: in time for this dive or for the next."""
        found = self._found if self.calibration is None else None
        if found is None:
            self.folder.write_cameras(mapped, self.calibration)
            return
        comment = f"found from the dive itself: focal length {found.words}"
        self.folder.write_cameras(mapped, found.camera if found.used else None, comment)
        if found.suggested:
            self.folder.write_suggested_camera(found.camera, comment)

    def _write_trajectory(self) -> None:
        times = {tracked.frame.index: tracked.frame.t_ns * 1e-9 for tracked in self.results}
        sub_maps = sorted({t.sub_map for t in self.results if t.frame.index in self.poses})
        comment = worlds_in_words({number: self.outputs.frame(number) for number in sub_maps})
        self.folder.write_trajectory(
            [times[i] for i in self.poses], list(self.poses.values()), comment
        )

    def _write_path_table(self) -> None:
        self.folder.write_path_table(self._path_rows())

    def _write_fixes(self) -> None:
        rows = fix_rows(self.outputs.frames, self.folder.rows)
        if rows:
            self.folder.write_fixes(rows)

    def _write_metric_file(self) -> None:
        self.folder.write_metric_frames(self.outputs.frames, self._main)

    def _write_georeference(self) -> None:
        content = georeference(self.outputs.frames, self._main)
        if content is not None:
            self.folder.write_json(GEOREFERENCE, content)

    def _write_in_site(self) -> None:
        if self.slam.in_base is not None:
            content = in_site(self.slam.in_base, self.slam.keyframes, self.slam.maps.taken_over)
            self.folder.write_json(IN_SITE, content)

    def _water(self) -> WaterSummary | None:
        """Of the largest sub-map, in the unit of its metric frame."""
        water = self._waters.get(self._main)
        return None if water is None else water_in(water, self.metric_frame.T_nm.scale)

    def _write_medium(self) -> None:
        self.folder.write_medium(self._medium_facts())

    @property
    def _is_water_known(self) -> bool:
        return self._main in self._waters or not self.slam.mappers

    def _medium_facts(self) -> dict[str, Any]:
        if not self._is_water_known:
            return {}
        mapper = self.slam.mappers.get(self._main)
        evidence = None if mapper is None else mapper.scene.water_evidence
        amplification = mean_amplification(self.held_out)
        return medium_json(self._water(), self.metric_frame, evidence, amplification)

    def _write_map(self, sub_map: int) -> None:
        suffix = "" if sub_map == self._main else f"_{sub_map}"
        water, frame = self._waters.get(sub_map), self.outputs.frame(sub_map)

        def write_map() -> None:
            self.folder.write_map(self.slam.mappers[sub_map], suffix)

        def write_splats() -> None:
            self.folder.write_splats(self.slam.mappers[sub_map], water, frame, suffix)

        self._attempt(f"writing map{suffix}.aqf", write_map)
        self._attempt(f"writing map{suffix}.ply", write_splats)


# --------------------------------------------------------------------------------------------------
# What a dive keeps at its end so that its places can be recognised another day.

log = logging.getLogger(__name__)


def write_places_of(dive: Path, slam: Slam, poses: Mapping[int, Sim3]) -> None:
    """places.npz in the folder of a dive; ``poses``: T_mc by frame index, as the map refined them.

    One keyframe at a time is in memory; one that cannot be read back costs itself. A dive without
    keyframes gets no file.

    Raises:
        InputError: the file cannot be written.
    """
    if slam.keyframes.readable:
        write_places(dive / NAME, _places(slam.keyframes, poses), _edges(slam.graph.snapshot))


def _places(
    keyframes: KeyframeStore, poses: Mapping[int, Sim3]
) -> Iterator[tuple[KeyframePlace, KeypointDepths]]:
    for keyframe in keyframes.readable:
        try:
            yield (
                _place(keyframe, poses),
                depths_at(keyframe.encoding.keypoints, keyframe.pointmap),
            )
        except InputError as error:
            log.warning("keyframe %d is not in %s: %s", keyframe.number, NAME, error)


def _place(keyframe: Keyframe, poses: Mapping[int, Sim3]) -> KeyframePlace:
    T_wc = keyframe.T_wc
    refined = poses.get(keyframe.frame_index, T_wc)
    return KeyframePlace(
        keyframe.number,
        keyframe.frame_index,
        keyframe.sub_map,
        keyframe.t_ns,
        Sim3(refined.R, refined.t, T_wc.scale),
        keyframe.pointmap.camera,
    )


def _edges(graph: Snapshot) -> Rows:
    """[E] EDGE"""
    rows = np.zeros(len(graph.edges), EDGE)
    for end in ("a", "b"):
        rows[end] = graph.nodes["number"][graph.edges[end]]
    for name in ("R", "t", "scale", "information", "loop"):
        rows[name] = graph.edges[name]
    rows["trust"] = graph.trust["trust"]
    return rows


# --------------------------------------------------------------------------------------------------
# What is made of a dive beside the files of the core: reports, plan views, numbers of the ground.
#
# Each is found by an entry point of ``GROUP``; so a site can have its own (docs/extending.md).

GROUP = "aquaflow.deliverables"
"""Entry points: subclasses of :class:`Deliverable`, each called with the dive's ``Slam``."""


class DeliverablePhase(IntEnum):
    """When, at the end of a dive, a deliverable is made."""

    WRITE = 1
    """After trajectory, cameras, maps and places."""
    MEASURE = 2
    """After the held-out views were evaluated; within the time that the dive's end has."""
    REPORT = 3
    """Last, when everything but ``metrics.json`` is in the folder."""


class Deliverable:
    """One thing that is made of a dive. Whatever it raises costs itself alone."""

    phase = DeliverablePhase.WRITE
    stage: str
    """What is done, in words, for the note on a failure: ``drawing the overview``."""

    def __init__(self, slam: Slam) -> None:
        """``slam``: of the dive, before its first frame."""
        self.slam = slam
        self.notes: list[str] = []
        """What :meth:`make` left out, and why, for the notes of the dive."""

    def look(self) -> None:
        """Take in what is new of the dive; called while the frames of a replay come, after each
        keyframe. A live dive's coverage is looked at by a thread of its own."""

    def refresh(self, dive: Dive) -> None:
        """Make it of a ``dive`` that goes on, where that is cheap."""

    def make(self, dive: Dive, until: Deadline) -> None:
        """Make it of a ``dive`` that has ended, and write it into its folder.

        Args:
            dive: with everything that is in memory by now.
            until: when to leave out what can be left out.

        Raises:
            InputError: a file cannot be written.
        """
        raise NotImplementedError


def deliverables_of(slam: Slam) -> dict[str, Deliverable]:
    """One of each that is installed, by name, in the order in which they are made: by phase, then
    by name. One that cannot be loaded costs itself."""
    found: dict[str, Deliverable] = {}
    for entry in entry_points(group=GROUP):
        with slam.failures.contain(f"loading the deliverable {entry.name}"):
            found[entry.name] = entry.load()(slam)
    return dict(sorted(found.items(), key=lambda each: (each[1].phase, each[0])))


# --------------------------------------------------------------------------------------------------
# The frames of a finished dive with what is known of each: class, pose, time, navigation.

NS = 1_000_000_000


@dataclass(frozen=True)
class FinishedFrame:
    """A frame of the recording."""

    row: FrameRow
    t_ns: int
    """Since the recording's first frame."""
    T_nc: Sim3 | None
    """Camera to n; None without a pose in the largest sub-map."""
    known: PoseRow | None
    """Of a frame with such a pose, in a dive that has trajectory.csv."""


def read_finished_frames(dive: Dive) -> list[FinishedFrame]:
    """Every frame that was asked for, in the order of the recording; poses and what is known of
    them only of the largest sub-map, whose world the map's is.

    Raises:
        InputError: a file is missing or damaged.
    """
    rows, main, path = dive.frames, dive.main, dive.trajectory
    poses = {
        _ns(float(t)): Sim3(R, position)
        for t, R, position in zip(path.t_s, path.R_wc, path.positions, strict=True)
    }
    known = {row.index: row for row in dive.poses} if dive.has(TRAJECTORY_CSV) else {}
    frames = []
    for row in sorted(rows, key=lambda row: row.t_s):
        t_ns, placed = _ns(row.t_s), row.sub_map == main
        frames.append(
            FinishedFrame(
                row, t_ns, poses.get(t_ns) if placed else None,
                known.get(row.index) if placed else None,
            )
        )  # fmt: skip
    return frames


def _ns(t_s: float) -> int:
    return round(t_s * NS)


def start_ns(metrics: dict[str, Any]) -> int | None:
    """UTC of the recording's first frame, ns since 1970; None where nothing stated it."""
    said = metrics.get("utc_start")
    if said is None:
        return None
    begun = datetime.fromisoformat(str(said).replace("Z", "+00:00"))
    whole = begun.replace(microsecond=0)
    return int(whole.timestamp()) * NS + begun.microsecond * 1000
