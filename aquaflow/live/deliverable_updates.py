"""Deliverables while the dive goes on: a container is killed, not stopped.

They are written in the mapping thread, behind the requests that wait there, in parts with mapping
in between. What they cost is measured, and bounds how often they are written.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow import __version__
from aquaflow.base.errors import InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.dive.dive import Dive
from aquaflow.dive.metric_outputs import MetricOutputs, frame_numbers, water_in, worlds_in_words
from aquaflow.dive.results import WaterSummary, medium_json
from aquaflow.dive.run import DiveRun
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.geometry.arrays import Array
from aquaflow.geometry.similarity import Sim3, Sim3Batch, quaternion_from_rotation
from aquaflow.live.map_thread import Job, MapThread
from aquaflow.mapping.work import MIN_VIEWS, OwnedMaps
from aquaflow.tracking.frame_table import CLASSES, NONE
from aquaflow.tracking.frames import FrameClass

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper

log = logging.getLogger(__name__)

SHARE = 0.03
"""Of one core, at most, for writing deliverables: with a million Gaussians 1.7 s in every 57."""


class DeliverableUpdater:
    """A watcher of the loop; :meth:`write_if_due` is called after every turn of it."""

    def __init__(
        self,
        run: DiveRun,
        maps: MapThread,
        every_s: float,
        now_s: Callable[[], float] = time.monotonic,
        cpu_s: Callable[[], float] = time.thread_time,
    ) -> None:
        """``cpu_s``: what the calling thread has used."""
        self.written = 0
        """Times that all of them were written."""
        self.took_s = 0.0
        """CPU time of the mapping thread for the last ones."""
        self._run, self._maps, self._every_s = run, maps, every_s
        self._now_s, self._cpu_s = now_s, cpu_s
        self._due_s = now_s() + every_s
        self._written_s: float | None = None
        self._writing = self._ended = False

    def write_if_due(self, disk_is_full: bool) -> None:
        """Begin to write, if it is time, nothing is being written, there is room and a map."""
        if self._now_s() < self._due_s or self._writing or self._ended or disk_is_full:
            return
        if len(self._run.slam.frames) < MIN_VIEWS or not self._maps.mappers:
            return
        self._writing, self.took_s = True, 0.0
        moment = Interim(self._run)
        parts: list[tuple[str, Job]] = [
            ("write the maps", lambda maps: moment.write_maps(maps.mappers)),
            ("write the path", lambda _: moment.write_path()),
            ("check the calibration", lambda _: self._run.check_calibration()),
            ("write the report", lambda maps: moment.write_report(maps.mappers)),
        ]
        self._post(parts, self._now_s())

    def write_soon(self) -> None:
        """Write at the next turn."""
        self._due_s = self._now_s()

    def end(self) -> None:
        """The dive's own deliverables come: what waits is not written."""
        self._ended = True

    def to_json(self) -> dict[str, Any]:
        """Counts for /health."""
        age_s = None if self._written_s is None else round(self._now_s() - self._written_s, 1)
        return {"written": self.written, "age_s": age_s, "cpu_s": round(self.took_s, 3)}

    def _post(self, parts: list[tuple[str, Job]], began_s: float) -> None:
        """The first of the parts, behind what waits for mapping; then the next."""
        (name, write), *rest = parts

        def work(maps: OwnedMaps) -> None:
            if self._ended:
                return
            before_s, failures = self._cpu_s(), maps.failures
            try:
                self._attempt(failures, name, lambda: write(maps))
            finally:
                self.took_s += self._cpu_s() - before_s
                self._next(rest, began_s)

        self._maps.later(name, work)

    def _next(self, rest: list[tuple[str, Job]], began_s: float) -> None:
        if rest:
            self._post(rest, began_s)
            return
        self.written, self._written_s = self.written + 1, began_s
        self._due_s = began_s + max(self._every_s, self.took_s / SHARE)
        self._writing = False

    def _attempt(self, failures: Failures, name: str, write: Callable[[], None]) -> None:
        """What fails is counted; a file that found no room is written the next time."""
        try:
            with failures.contain(name):
                write()
        except InputError as error:
            log.warning("%s", error)


# --------------------------------------------------------------------------------------------------
# What is written: maps, trajectory and report as they are at one moment, without refining, held-out
# views and tables. The moment is taken in tracking's thread, which costs it microseconds;
# everything else is for the thread that owns the maps. Each file is whole, and the next one
# replaces it.

WATER_VIEWS = 8
"""Views that the water's ranges are taken from: 0.1 s at 480 px, where the end takes ten times as
many."""
NOTE = (
    "this was written while the dive went on: the map is not refined and no view was held against "
    "it; `aquaflow run finish` does both for a dive that was cut off"
)


@dataclass(frozen=True)
class DivePoses:
    """Posed frames in the order of the table, in n."""

    index: npt.NDArray[np.int64]
    """[P] of the frames."""
    t_s: npt.NDArray[np.float64]
    """[P] of the dive."""
    positions: npt.NDArray[np.float64]
    """[P, 3]"""
    wxyz: npt.NDArray[np.float64]
    """[P, 4] n from camera."""
    sub_maps: npt.NDArray[np.int64]
    """[P]"""
    classes: npt.NDArray[np.uint8]
    """[P] by their place in CLASSES."""


class Interim:
    """One moment of a dive."""

    def __init__(self, run: DiveRun) -> None:
        """In tracking's thread: tables that never change are shared, the others copied."""
        slam = run.slam
        self._run, self._parts = run, slam.frames.parts()
        self._keyframes = [(each.T_wc, each.sub_map) for each in slam.keyframes.keyframes]
        sub_maps = {sub_map for _, sub_map in self._keyframes}
        self._outputs = MetricOutputs({number: slam.metric_frame(number) for number in sub_maps})
        self._dropped, self._notes = len(run.dropped), list(run.notes)
        self._waters: dict[int, WaterSummary | None] = {}
        self._poses: DivePoses | None = None

    def write_maps(self, mappers: Mapping[int, Mapper]) -> None:
        """map.ply and map_clear.ply of every sub-map, with the water as it is known by now."""
        main = self._main
        for number, mapper in mappers.items():
            if len(mapper.gaussians):
                from aquaflow.dive.map_file import summarise_water  # loads torch

                self._waters[number] = summarise_water(mapper, WATER_VIEWS)
                suffix = "" if number == main else f"_{number}"
                frame, water = self._outputs.frame(number), self._waters[number]
                self._run.folder.write_splats(mapper, water, frame, suffix)

    def write_path(self) -> None:
        """trajectory.tum, metric.json and the cameras."""
        poses, folder = self._pose(), self._run.folder
        frames = {int(n): self._outputs.frame(int(n)) for n in np.unique(poses.sub_maps)}
        order = np.argsort(poses.t_s, kind="stable")
        folder.write_poses(
            poses.t_s[order], poses.positions[order], poses.wxyz[order], worlds_in_words(frames)
        )
        folder.write_metric_frames(self._outputs.frames, self._main)
        camera = self._run.slam.tracker.camera
        if camera is not None:
            folder.write_cameras(camera, self._run.calibration)

    def write_report(self, mappers: Mapping[int, Mapper]) -> None:
        """metrics.json, and what the deliverables make of the moment."""
        run = self._run
        numbers = self._numbers(sum(len(mapper.gaussians) for mapper in mappers.values()))
        run.folder.write_json("metrics.json", numbers)
        if run.slam.tracker.camera is None:
            return
        dive = self._dive(numbers, mappers)
        for name, each in run.deliverables.items():
            with run.slam.failures.contain(name):
                each.refresh(dive)

    def _dive(self, numbers: dict[str, Any], mappers: Mapping[int, Mapper]) -> Dive:
        """What is known of the moment; notes of a dive that goes on are in no file."""
        run, waters = self._run, self._waters
        frame, water = self._outputs.frame(self._main), waters.get(self._main)
        known = None if water is None else water_in(water, frame.T_nm.scale)
        notes = [NOTE, *self._notes, *run.slam.failures.notes()]
        return Dive(
            run.folder.path,
            name=run.name,
            config=run.config,
            camera=run.slam.tracker.camera,
            is_calibrated=run.calibration is not None,
            metrics=numbers | {"notes": notes},
            metric_frames=self._outputs.frames,
            main=self._main,
            poses=self._rows(),
            medium_facts=medium_json(known, frame),
            attenuations={n: each.beta_a for n, each in waters.items() if each is not None},
            maps=mappers,
            held_out=[],
        )

    def _rows(self) -> list[PoseRow]:
        """Each pose in the order of the recording; what telemetry says of it comes at the end."""
        poses, rows = self._pose(), []
        for i in np.argsort(poses.index, kind="stable"):
            x, y, z = poses.positions[i].tolist()
            number = int(poses.sub_maps[i])
            unit = self._outputs.frame(number).unit
            index, t_s = int(poses.index[i]), float(poses.t_s[i])
            rows.append(PoseRow(index, t_s, None, number, x, y, z, unit))
        return rows

    @property
    def _main(self) -> int:
        """The sub-map with the most posed frames; the earliest of equals."""
        counts = np.bincount(self._pose().sub_maps, minlength=1)
        return int(counts.argmax())

    def _pose(self) -> DivePoses:
        if self._poses is None:
            self._poses = pose(self._parts, self._keyframes, self._outputs)
        return self._poses

    def _numbers(self, gaussians: int) -> dict[str, Any]:
        """The keys of metrics.json that are known."""
        slam, poses = self._run.slam, self._pose()
        kinds = Counter(np.concatenate([part["class"] for part in self._parts]).tolist())
        count = {kind: kinds[CLASSES.index(kind)] for kind in FrameClass if kind in CLASSES}
        return {
            "complete": False,
            "frames": sum(count.values()) + self._dropped,
            "tracked": len(poses.index),
            "lost": count[FrameClass.LOST],
            "skipped": count[FrameClass.SKIPPED] + self._dropped,
            "keyframes": count[FrameClass.KEYFRAME],
            "mapping_frames": count[FrameClass.MAPPING],
            "common_frames": count[FrameClass.COMMON],
            "sub_maps": len(np.unique(poses.sub_maps)),
            "loops": slam.graph.loops,
            "gaussians": gaussians,
            **dict.fromkeys(("psnr", "ssim", "flip", "lpips", "lpips_alex")),
            "heldout_frames": 0,
            "stage_ms": {},
            "warnings": self._run.calibration_warnings + slam.failures.defects(),
            "calibration_check": self._run.calibration_numbers,
            "failures": slam.failures.to_json(),
            "version": __version__,
            **frame_numbers(self._outputs.frame(self._main)),
        }


def pose(
    parts: list[Array],  # each [n] FRAME
    keyframes: list[tuple[Sim3, int]],  # pose and sub-map of each
    outputs: MetricOutputs,
) -> DivePoses:
    """The posed frames of a table, each by its keyframe."""
    rows = np.concatenate(parts)
    rows = rows[rows["keyframe"] != NONE]
    numbers = rows["keyframe"]
    sub_maps = np.array([sub_map for _, sub_map in keyframes], np.int64)[numbers]
    world = _in_n(keyframes, outputs)[numbers] @ _poses_of(rows["T_kf"])
    numbers = np.hstack([world.R.reshape(-1, 9), world.t])
    sound = np.flatnonzero(np.isfinite(numbers).all(axis=1))
    rows, sub_maps, world = rows[sound], sub_maps[sound], world[sound]
    wxyz = quaternion_from_rotation(world.R) if len(rows) else np.zeros((0, 4))
    return DivePoses(
        rows["index"], rows["t_ns"] * 1e-9, world.t, wxyz, sub_maps, rows["class"],
    )  # fmt: skip


def _in_n(keyframes: list[tuple[Sim3, int]], outputs: MetricOutputs) -> Sim3Batch:
    """[K] from each keyframe to the n of its sub-map."""
    if not keyframes:
        return _poses_of(np.zeros((0, 13)))
    return Sim3Batch.of([outputs.frame(number).T_nm @ T_wc for T_wc, number in keyframes])


def _poses_of(
    rows: npt.NDArray[np.float64],  # [N, 13] as of_sim3 makes them
) -> Sim3Batch:
    return Sim3Batch(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:12], rows[:, 12])
