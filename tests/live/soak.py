"""Hours of a live dive in less time: does anything grow that should not?

``python tests/live/soak.py FRAMES FOLDER`` swims a small synthetic dive, which closes on itself,
round after round through the real live loop: tracking, the mapping thread, checkpoints, the health
server. What is compressed is time alone: a frame, dated 0.1 s after the one before, comes as soon
as the loop asks for one, so that none is overtaken. Each round's pictures have sensor noise of
their own, and after the first rounds there is nothing new to map.
"""

from __future__ import annotations

import itertools
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from aquaflow.config.service import ListenConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.live.checkpoint.resume import resume_folder
from aquaflow.live.feed import ASK_S, _Pumps
from aquaflow.live.health.http import HealthServer, ask
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.loop import LiveLoop
from aquaflow.live.report import report
from aquaflow.sources import open_recording
from aquaflow.sources.outbound import OutboundMessage
from aquaflow.types import CameraModel, Frame

ROUND = SyntheticConfig(frames=120, width=96, height=72)
FRAME_NS = 100_000_000
NOISE = 1.3
"""Grey levels, of each picture anew."""
SAMPLES = 200
FEW = {"steps_keyframe": 2, "steps_mapping": 2, "steps_common": 1, "refine_steps": 20}
VEHICLE = VehicleConfig.model_validate(
    {
        "threads": 1,
        "mapping": {"optimiser": FEW | {"heldout_steps": 2}, "max_gaussians": 10_000},
        "service": {
            "mapping": {"steps_per_view": 2, "nice": 5},
            "health": {"enabled": False, "port": 8230},
        },
    }
)


class Rounds(_Pumps):
    """A recording that closes on itself, again and again."""

    def __init__(self, recording: Path, frames: int) -> None:
        super().__init__()
        source = open_recording(recording)
        self.calibration: CameraModel | None = source.camera
        self._frames, self._count = list(source.frames()), frames
        source.close()

    def name_of(self, index: int) -> str:
        return f"round{index // len(self._frames)}#{index % len(self._frames)}"

    def describe(self) -> dict[str, dict[str, object]]:
        return {}

    def send(self, message: OutboundMessage) -> bool:
        return False

    def start(self) -> None:
        self.pump("rounds", self._swim, last=True)

    def close(self) -> None:
        self.join()

    def _swim(self) -> None:
        for frame in itertools.islice(self.pictures(), self._count):
            while not self.newest.wait_for_consumer(ASK_S):
                if self.closing.is_set():
                    return
            self.newest.put(replace(frame, arrival_ns=time.monotonic_ns()))

    def pictures(self) -> Iterator[Frame]:
        """Round after round, without an end."""
        rng = np.random.default_rng(0)
        for index in itertools.count():
            frame = self._frames[index % len(self._frames)]
            assert isinstance(frame, Frame)
            noise = NOISE * rng.standard_normal(frame.image.shape, np.float32)
            image = (frame.image + noise).round().clip(0, 255).astype(np.uint8)
            yield replace(frame, index=index, t_ns=index * FRAME_NS, image=image)


@dataclass(frozen=True)
class Sample:
    """What there is at one moment."""

    frame: int
    wall_s: float
    rss_kb: int
    threads: int
    descriptors: int
    waiting: int
    """Requests to the mapping thread."""
    keyframes: int
    gaussians: int
    views: int
    held_out: int
    files: int
    """In work/."""
    posed: int
    """Frames with a pose."""


class Sampler:
    """Looks at the process now and then, from the loop; asks the health server as well."""

    def __init__(self, dive: LiveDive, every: int, file: Path, url: str = "") -> None:
        """What is seen goes to ``file`` at once, a line of CSV each time; ``url``: the server's."""
        self.samples: list[Sample] = []
        self._dive, self._url, self._every, self._file = dive, url, every, file
        self._file.write_text(",".join(field.name for field in fields(Sample)) + "\n")
        self._began_s = time.monotonic()

    def update(self, loop: LiveLoop) -> None:
        due = self._every * (1 + len(self.samples))
        if loop.counters.frames >= due:
            assert not self._url or ask(self._url)["frames"] >= due
            self.samples.append(self._sample(loop))
            with self._file.open("a") as stream:
                stream.write(",".join(map(str, asdict(self.samples[-1]).values())) + "\n")

    def _sample(self, loop: LiveLoop) -> Sample:
        parts, classes = self._dive.parts, loop.counters.classes
        mappers = list(parts.maps.mappers.values())
        return Sample(
            loop.counters.frames,
            round(time.monotonic() - self._began_s, 1),
            rss_kb(),
            threading.active_count(),
            descriptors(),
            parts.maps.waiting,
            len(parts.slam.keyframes),
            sum(len(mapper.gaussians) for mapper in mappers),
            sum(len(mapper.views) for mapper in mappers),
            sum(len(views) for views in parts.maps.held_out.values()),
            sum(len(files) for _, _, files in os.walk(self._dive.folder.work)),
            sum(classes[kind] for kind in ("keyframe", "mapping", "common")),
        )


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def rss_kb() -> int:
    """Memory of this process that is resident."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def descriptors() -> int:
    """Open files, sockets and the like."""
    return len(os.listdir("/proc/self/fd"))


def soak(frames: int, folder: Path, vehicle: VehicleConfig = VEHICLE) -> list[Sample]:
    """Swim ``frames`` frames; the dive lies in ``folder`` afterwards, the samples beside it."""
    recording = folder / "recording"
    if not recording.exists():
        write_dive(recording, ROUND)
    feed = Rounds(recording, frames)
    with LiveDive("soak", resume_folder(folder / "dive", new=True), feed, vehicle, True) as dive:
        server = HealthServer(ListenConfig(port=_free_port()), lambda: report(dive.parts, 1e6))
        try:
            url = f"http://127.0.0.1:{server.port}"
            sampler = Sampler(dive, max(1, frames // SAMPLES), folder / "soak.csv", url)
            dive.parts.loop.watchers.append(sampler.update)
            dive.run()
        finally:
            server.close()
    return sampler.samples


def summary(samples: list[Sample]) -> dict[str, object]:
    """The second half: medians of the tenth of the dive around its middle, and of its last."""
    tenth = max(1, len(samples) // 10)
    middle = len(samples) // 2 - tenth // 2
    half, end = samples[middle : middle + tenth], samples[-tenth:]

    def medians(some: list[Sample]) -> dict[str, float]:
        return {
            field.name: float(np.median([getattr(sample, field.name) for sample in some]))
            for field in fields(Sample)
        }

    before, after = medians(half), medians(end)
    return {
        "half": before,
        "end": after,
        "rss_growth_percent": round(100.0 * (after["rss_kb"] / before["rss_kb"] - 1.0), 2),
        "bytes_per_frame": round(
            1024.0 * (after["rss_kb"] - before["rss_kb"]) / (after["frame"] - before["frame"]), 1
        ),
        "most_waiting": max(sample.waiting for sample in samples),
    }


if __name__ == "__main__":
    found = soak(int(sys.argv[1]), Path(sys.argv[2]))
    print(json.dumps(summary(found), indent=2))
