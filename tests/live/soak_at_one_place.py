"""Two hours over one place, live: does tracking drift, and does anything grow that should not?

``python -m tests.live.soak_at_one_place FRAMES FOLDER`` hovers, wanders, leaves and comes back
(:mod:`aquaflow.lab.stress.one_place`) through the real live loop, and prints a line of
numbers for every hundredth of the dive; they are in ``FOLDER/soak.csv`` as well. Without ``--map``
only tracking and the keyframe graph run. Time alone is compressed: a frame, dated 0.1 s after the
one before, comes as soon as the loop asks for one. Half an hour of a free core for 72,000 frames
of 160 px without a map; ``--width 112`` takes two thirds of it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from itertools import count
from pathlib import Path

import numpy as np

from aquaflow.config.vehicle import VehicleConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.stress.one_place import OnePlace
from aquaflow.lab.stress.swim import CAMERA
from aquaflow.live.checkpoint.resume import resume_folder
from aquaflow.live.feed import _Pumps
from aquaflow.live.health.state import ServiceState
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.loop import LiveLoop
from aquaflow.types import Frame
from tests.live.soak import VEHICLE, Rounds, rss_kb

SAMPLES = 100
ALIGNED = 2000
"""Frames at the beginning whose poses say where the map's origin is; drift shows from there."""
PRINTED = "{frame:6d}  error {error_cm:6.2f} cm, 95 %: {error_p95_cm:6.2f}  scale {scale_percent:+5.2f} %  {keyframes:4d} keyframes {loops:5d} loops {edges:5d} edges {sub_maps} sub-maps  {rss_kb:7d} kB {cpu_ms:5.1f} ms  inconsistent {inconsistent}, lost {lost} times"  # noqa: E501


class AtOnePlace(Rounds):
    """Pictures of the place, made as they are asked for."""

    def __init__(self, place: OnePlace, frames: int) -> None:
        _Pumps.__init__(self)
        self.place, self.calibration, self._count = place, place.camera, frames

    def name_of(self, index: int) -> str:
        return f"moment{index}"

    def pictures(self) -> Iterator[Frame]:
        return (self.place.frame(index) for index in count())


@dataclass(frozen=True)
class Sample:
    """What there is at one moment, and how it went since the last one."""

    frame: int
    wall_s: float
    cpu_ms: float
    """Of all threads, per frame; making the picture included."""
    rss_kb: int
    posed: int
    """Frames with a pose."""
    error_cm: float
    error_p95_cm: float
    """Position against the truth, by the alignment of the first frames; NaN before those are in."""
    scale_percent: float
    """Of the path since the last sample, against that of the first frames."""
    keyframes: int
    loops: int
    edges: int
    sub_maps: int
    inconsistent: int
    """Times that the state was "tracking, inconsistent" so far."""
    lost: int
    """Times that it was "lost"."""


class Observer:
    """Compares every pose, at the moment at which it is there, with the truth."""

    def __init__(self, dive: LiveDive, place: OnePlace, frames: int, file: Path) -> None:
        self.samples: list[Sample] = []
        self._dive, self._place, self._file = dive, place, file
        self._every, self._aligned = max(1, frames // SAMPLES), min(ALIGNED, frames // 2)
        self._file.write_text(",".join(field.name for field in fields(Sample)) + "\n")
        self._found: dict[int, Sim3] = {}
        self._posed, self._origin = 0, Sim3.identity()
        self._is_aligned = False
        self._began_s, self._cpu_s = time.monotonic(), time.process_time()

    def update(self, loop: LiveLoop) -> None:
        newest = loop.latest
        if newest is not None and newest.T_wc is not None:
            self._found[newest.frame.index] = newest.T_wc
        frames = loop.counters.frames
        if not self._is_aligned and frames >= self._aligned:
            self._origin, self._is_aligned = self._alignment(), True
        if frames >= self._every * (1 + len(self.samples)):
            self.samples.append(self._sample(loop))
            with self._file.open("a") as stream:
                stream.write(",".join(map(str, asdict(self.samples[-1]).values())) + "\n")
            print(PRINTED.format(**asdict(self.samples[-1])), flush=True)
            self._posed += len(self._found)
            self._found = {} if self._is_aligned else self._found

    def _alignment(self) -> Sim3:
        found = np.array([T_wc.t for T_wc in self._found.values()])
        truth = np.array([self._place.T_wc(index).t for index in self._found])
        return align(found, truth, with_scale=True).T_target_source

    def _sample(self, loop: LiveLoop) -> Sample:
        frames, cpu_s, slam = loop.counters.frames, time.process_time(), self._dive.parts.slam
        cpu_ms, self._cpu_s = 1e3 * (cpu_s - self._cpu_s) / self._every, cpu_s
        error, scale = np.array([np.nan]), float("nan")
        if self._is_aligned and len(self._found) > 10:
            found = np.array([T_wc.t for T_wc in self._found.values()])
            truth = np.array([self._place.T_wc(index).t for index in self._found])
            error = 100.0 * np.linalg.norm(self._origin.apply(found) - truth, axis=1)
            scale = 100.0 * (self._origin.scale / self._alignment().scale - 1.0)
        return Sample(
            frames,
            round(time.monotonic() - self._began_s, 1),
            round(cpu_ms, 2),
            rss_kb(),
            sum(loop.counters.classes[kind] for kind in ("keyframe", "mapping", "common")),
            round(float(np.median(error)), 3),
            round(float(np.percentile(error, 95)), 3),
            round(scale, 3),
            len(slam.keyframes),
            slam.graph.loops,
            len(slam.graph.snapshot.edges),
            slam.tracker.sub_maps,
            loop.health.visits[ServiceState.INCONSISTENT],
            loop.health.visits[ServiceState.LOST],
        )


def soak(
    frames: int, folder: Path, place: OnePlace | None = None, mapping: bool = False
) -> list[Sample]:
    """Hover for ``frames`` frames; the dive is in ``folder`` afterwards, with the samples."""
    place = place or OnePlace()
    folder.mkdir(parents=True, exist_ok=True)
    settings = VEHICLE.model_dump()
    settings["mapping"]["enabled"] = mapping
    vehicle = VehicleConfig.model_validate(settings)
    choice = resume_folder(folder / "dive", new=True)
    with LiveDive("soak", choice, AtOnePlace(place, frames), vehicle, True) as dive:
        observer = Observer(dive, place, frames, folder / "soak.csv")
        dive.parts.loop.watchers.append(observer.update)
        dive.run()
    return observer.samples


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("frames", type=int)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--width", type=int, default=CAMERA.width)
    parser.add_argument("--map", action="store_true")
    asked = parser.parse_args()
    camera = CAMERA.resize(asked.width, asked.width * CAMERA.height // CAMERA.width)
    soak(asked.frames, asked.folder, OnePlace(camera=camera), asked.map)
