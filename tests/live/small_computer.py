"""What a small computer must hold: live tracking, recording and a small map of the endless survey.

``python -m tests.live.small_computer SECONDS FOLDER`` lets the survey's pictures come at their
rate, 10 a second, into the real live loop with a recorder, checkpoints and the mapping thread, on
two threads, and prints a line every 10 s: resident set, CPU time, and how many were overtaken.
``taskset -c 0,1`` in front of it gives it no more than two cores. Making a picture is part of the
CPU time: 23 ms at 320 px.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from aquaflow.config.presets import preset
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.lab.bench.growth.worker import folder_bytes
from aquaflow.lab.bench.memory import peak_memory_mb, resident_mb
from aquaflow.lab.synthetic.survey import FPS, SurveyPictures
from aquaflow.live.checkpoint.resume import resume_folder
from aquaflow.live.feed import LiveFeed
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.loop import LiveLoop
from aquaflow.live.recorder.recorder import Recorder
from aquaflow.types import CameraModel, Frame

CAMERA = "camera"
EVERY_S = 10.0
"""Between two lines."""


class SurveyCamera:
    """The survey as a device: a picture every tenth of a second, whoever is ready for it."""

    def __init__(self, width: int, count: int) -> None:
        self._survey, self._count = SurveyPictures(width), count
        self.camera: CameraModel | None = self._survey.camera
        self.frame_count: int | None = count
        self.notes: list[str] = []
        self._closed = threading.Event()

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        began_ns = time.monotonic_ns()
        for frame in self._survey.frames(self._count):
            due_ns = began_ns + frame.t_ns
            if self._closed.wait(max(due_ns - time.monotonic_ns(), 0) * 1e-9):
                return
            yield replace(frame, t_ns=due_ns, arrival_ns=time.monotonic_ns())

    def close(self) -> None:
        self._closed.set()


class Watcher:
    """Prints how it goes."""

    def __init__(self, dive: LiveDive) -> None:
        self._slam = dive.parts.slam
        self._began_s, self._next_s, self._cpu_s = time.monotonic(), 0.0, time.process_time()
        self._seen = 0

    def update(self, loop: LiveLoop) -> None:
        since_s = time.monotonic() - self._began_s
        if since_s < self._next_s:
            return
        self._next_s += EVERY_S
        self._seen = loop.counters.frames
        gaussians = sum(len(mapper.gaussians) for mapper in self._slam.mappers.values())
        newest = -1 if loop.latest is None else loop.latest.frame.index
        print(
            f"{since_s:6.1f} s  {resident_mb():6.0f} MB, peak {peak_memory_mb():6.0f}  "
            f"CPU {time.process_time() - self._cpu_s:6.1f} s  {self._seen:5d} of {newest + 1:5d} "
            f"pictures taken, {len(self._slam.keyframes):4d} keyframes, {gaussians:6d} Gaussians",
            flush=True,
        )


def vehicle(width: int, gaussians: int, mapping: bool) -> VehicleConfig:
    """The preset for little effort, with a smaller map yet."""
    settings: dict[str, Any] = preset("fast")
    settings["threads"], settings["source"] = 2, {"width": width}
    settings["mapping"] |= {"enabled": mapping, "max_gaussians": gaussians}
    settings["service"] = {"health": {"enabled": False, "port": 8230}}
    return VehicleConfig.model_validate(settings)


def dive(seconds: float, folder: Path, width: int, gaussians: int, mapping: bool) -> None:
    """Dive for ``seconds``; recording and dive are in ``folder`` afterwards."""
    config = vehicle(width, gaussians, mapping)
    recorder = Recorder(folder / "recording", config.recording)
    camera = SurveyCamera(width, int(seconds * FPS))
    feed = LiveFeed(CAMERA, {CAMERA: camera}, None, config.source, recorder)
    choice = resume_folder(folder / "dive", new=True)
    with LiveDive("small computer", choice, feed, config, True) as live:
        live.parts.loop.watchers.append(Watcher(live).update)
        live.run()
    recorded = folder_bytes(folder / "recording") / 1e6
    print(f"peak {peak_memory_mb()} MB; {recorded:.1f} MB recorded")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--max-gaussians", type=int, default=20_000)
    parser.add_argument("--tracking-only", action="store_true")
    asked = parser.parse_args()
    dive(asked.seconds, asked.folder, asked.width, asked.max_gaussians, not asked.tracking_only)
