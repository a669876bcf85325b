"""What a small computer must hold: the whole service with map, recording and checkpoints.

``python -m tests.live.small_computer SECONDS FOLDER`` (as root, control groups of version 1) starts
``aquaflow run`` where it gets two cores at 40 % each and 1.5 GB, about a Raspberry Pi 5, lets a
network camera show it 5 pictures a second, ends the dive, and prints a line every 10 s and a
summary. The camera, outside, shows the endless survey, or with ``--clip`` a folder of
``../shared/data`` swum there and back. ``--settings`` is merged into the vehicle's file.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from aquaflow.config.presets import merge
from aquaflow.geometry.camera import load_camera, save_camera
from aquaflow.lab.synthetic.survey import SurveyPictures
from aquaflow.sim_drivers.camera_feed import CameraFeed
from aquaflow.sim_drivers.mjpeg_server import MjpegServer
from aquaflow.sources import open_recording
from aquaflow.types import CameraModel, Frame
from tests.live.control_group import ControlGroup

FPS = 5.0
CORES, CPU_SHARE, MEMORY_MB = 2, 0.4, 1500
WIDTH = 320
"""Of the mapped pictures, and of the survey's; a clip's camera has twice as many pixels across."""
EVERY_S = 10.0
"""Between two lines."""
ENDING_S = 400.0
"""Longest wait for the end of a dive."""


class SurveyCamera:
    """Every second picture of the survey, which has ten a second."""

    def __init__(self) -> None:
        self._survey = SurveyPictures(WIDTH)
        self.camera: CameraModel | None = self._survey.camera
        self.frame_count: int | None = None
        self.notes: list[str] = []

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        for index in range(0, 1_000_000, 2):
            yield self._survey.frame(index)

    def close(self) -> None: ...


class ClipCamera:
    """Real pictures there and back: at FPS a second, the clip's own speed."""

    def __init__(self, folder: Path, every: int) -> None:
        film = next(path for path in sorted(folder.iterdir()) if path.suffix in (".mp4", ".mcap"))
        width = 2 * WIDTH
        left = "side_by_side" in film.name
        self._pictures: list[Frame] = []
        for frame in open_recording(film).frames(every=every):
            if isinstance(frame, Frame):
                image = frame.image[:, : frame.image.shape[1] // 2] if left else frame.image
                height = round(width * image.shape[0] / image.shape[1])
                small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
                small = np.asarray(small, np.uint8)
                self._pictures.append(replace(frame, image=small, encoded=None))
        height, width = self._pictures[0].image.shape[:2]
        self.camera: CameraModel | None = load_camera(folder / "camera.yaml").resize(width, height)
        self.frame_count: int | None = None
        self.notes: list[str] = []

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        yield from self._pictures
        yield from self._pictures[-2:0:-1]

    def close(self) -> None: ...


class Service:
    """``aquaflow run`` in its group."""

    def __init__(
        self, folder: Path, config: Path, port: int, group: ControlGroup | None, preset: str | None
    ) -> None:
        command = [sys.executable, "-m", "aquaflow", "run", "--config", str(config)]
        command += ["--out", str(folder / "dive")] + (["--preset", preset] if preset else [])
        self._address = f"http://127.0.0.1:{port}"
        self._log = (folder / "service.log").open("w")
        self.process = subprocess.Popen(
            command,
            stdout=self._log,
            stderr=self._log,
            preexec_fn=None if group is None else group.enter,  # noqa: PLW1509 - no threads yet
        )
        self.began_s = time.monotonic()

    def health(self) -> dict[str, Any] | None:
        """None while it does not answer."""
        asked = self._address + "/health"
        with (
            contextlib.suppress(OSError, ValueError),
            urllib.request.urlopen(asked, timeout=5.0) as answer,
        ):
            return dict(json.loads(answer.read()))
        return None

    def post(self, request: str) -> None:
        url = f"{self._address}/dive/{request}"
        urllib.request.urlopen(urllib.request.Request(url, method="POST"), timeout=10.0).close()

    def threads(self) -> dict[str, float]:
        """CPU seconds of each thread, by its number."""
        seconds: dict[str, float] = {}
        for stat in Path(f"/proc/{self.process.pid}/task").glob("*/stat"):
            with contextlib.suppress(OSError):
                user, system = stat.read_text().rpartition(")")[2].split()[11:13]
                ticks = int(user) + int(system)
                seconds[stat.parent.name] = ticks / os.sysconf("SC_CLK_TCK")
        return seconds

    def resident_mb(self) -> float:
        with contextlib.suppress(OSError):
            for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
                if line.startswith("VmRSS"):
                    return int(line.split()[1]) / 1024
        return 0.0

    def close(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(ENDING_S)
        self._log.close()


def show(service: Service, health: dict[str, Any], usage: dict[str, float]) -> None:
    """A line of how it goes."""
    lag, camera = health["lag_ms"], health["devices"]["front"]
    print(
        f"{time.monotonic() - service.began_s:6.0f} s  {health['state']}, {health['level']}  "
        f"lag {lag['p50'] or 0:.0f}, {lag['p95'] or 0:.0f}, {lag['max'] or 0:.0f} ms  "
        f"{health['frames']} frames, {health['overtaken']} overtaken, "
        f"{camera.get('dropped', 0)} dropped  "
        f"{health['keyframes']} keyframes, {health['gaussians']} Gaussians, "
        f"{health['mapping_waits']} wait, {health['mapped_without_steps']} without steps, "
        f"left out {sum(health['left_out_of_the_map'].values())}, "
        f"{health['mapping_rests']} rests  "
        f"{service.resident_mb():.0f} MB resident, {usage.get('anonymous_mb', 0):.0f} anonymous, "
        f"{usage.get('memory_peak_mb', 0):.0f} peak  "
        f"CPU {sum(service.threads().values()):.1f} s, "
        f"throttled {usage.get('throttled_s', 0):.1f} s  load {os.getloadavg()[0]:.1f}",
        flush=True,
    )


def watch(service: Service, seconds: float, group: ControlGroup | None) -> dict[str, Any]:
    """The dive until ``seconds`` after its first frame; the last health."""
    last: dict[str, Any] = {}
    begun_s, due_s = None, 0.0
    while service.process.poll() is None:
        health, now = service.health(), time.monotonic()
        if health is not None:
            last = health
            begun_s = now if begun_s is None and health["frames"] else begun_s
            if now >= due_s:
                due_s = now + EVERY_S
                show(service, health, group.read() if group else {})
        if begun_s is not None and now - begun_s >= seconds:
            break
        time.sleep(2.0)
    return last


def end(service: Service) -> float:
    """Finish the dive; the seconds that takes."""
    began_s = time.monotonic()
    service.post("finish")
    while time.monotonic() - began_s < ENDING_S and service.process.poll() is None:
        health = service.health()
        if health is not None and health["dive"]["state"] == "idle":
            break
        time.sleep(0.5)
    return time.monotonic() - began_s


def free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return int(listening.getsockname()[1])


def vehicle_file(folder: Path, camera: CameraModel, url: str, port: int, more: str) -> Path:
    """A vehicle with a network camera, which records."""
    save_camera(camera, folder / "camera.yaml")
    front = {"kind": "stream", "url": url, "calibration": str(folder / "camera.yaml")}
    settings: dict[str, Any] = {
        "cameras": {"front": front},
        "source": {"width": WIDTH},
        "service": {
            "record": True, "health": {"port": port}, "dives": str(folder / "dives"),
            "dive": {"begin": "at_once"},
        },
    }  # fmt: skip
    path = folder / "vehicle.yaml"
    path.write_text(yaml.safe_dump(merge(settings, yaml.safe_load(more) or {})))
    return path


def run(asked: argparse.Namespace) -> None:
    """One dive, and its summary as JSON."""
    folder: Path = asked.folder
    folder.mkdir(parents=True)
    camera = ClipCamera(asked.clip, asked.every) if asked.clip else SurveyCamera()
    assert camera.camera is not None
    with contextlib.ExitStack() as around:
        server = around.enter_context(MjpegServer(CameraFeed(camera, FPS)))
        group = None
        if not asked.unlimited:
            group = ControlGroup(f"aquaflow-{os.getpid()}", CORES, CPU_SHARE, MEMORY_MB)
            around.enter_context(group)
        port = free_port()
        config = vehicle_file(folder, camera.camera, server.url, port, asked.settings)
        service = Service(folder, config, port, group, asked.preset)
        around.callback(service.close)
        last = watch(service, asked.seconds, group)
        threads, usage = service.threads(), group.read() if group else {}
        ended_s = end(service) if service.process.poll() is None else None
        at_end: dict[str, Any] = {"usage_at_end": group.read() if group else {}}
        at_end["resident_at_end_mb"] = round(service.resident_mb())
    summary = {
        "seconds": asked.seconds, "end_of_dive_s": ended_s, "exit_code": service.process.returncode,
        "usage": usage, **at_end, "threads_cpu_s": threads, "health": last,
    }  # fmt: skip
    (folder / "summary.json").write_text(json.dumps(summary, indent=1))
    metrics = folder / "dive" / "metrics.json"
    if metrics.is_file():
        known = json.loads(metrics.read_text())
        shown = ("frames", "tracked", "keyframes", "gaussians", "psnr", "heldout_frames")
        print({key: known.get(key) for key in shown}, known.get("notes"))
    print(f"end of the dive {ended_s} s", at_end, usage)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--clip", type=Path)
    parser.add_argument(
        "--every", type=int, default=6, help="of the clip: 6 of 30 pictures a second"
    )
    parser.add_argument("--preset")
    parser.add_argument("--settings", default="")
    parser.add_argument("--unlimited", action="store_true")
    run(parser.parse_args())
