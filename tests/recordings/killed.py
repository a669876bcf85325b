"""A recording that is killed: ``aquaflow record`` in a process of its own, and what is left."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from aquaflow.recordings.mcap_camera import McapCamera
from aquaflow.recordings.mcap_messages import McapMessages, mcap_files
from aquaflow.recordings.mcap_telemetry import McapTelemetry
from aquaflow.types import Dropped
from tests.small_recording import GIVE_UP_S

FPS = 30

BEGUN_S = GIVE_UP_S
"""Longest wait for the first pictures; importing takes a second, on a busy machine more."""

FIRST_BYTES = 20_000
"""More than schemas and calibration."""


@dataclass(frozen=True)
class Killed:
    """What one killed recording left behind."""

    ran_s: float
    """From the first pictures on the disk to the kill."""
    lost_s: float
    """From the last picture on the disk to the kill."""
    cpu_share: float
    """Of one core, over that time."""
    pictures: int
    samples: int
    unreadable: int


def write_source(folder: Path, seconds: float, width: int, height: int) -> None:
    """A folder of JPEG pictures at 30 a second, and 50 attitudes a second beside them."""
    import cv2
    import numpy as np

    images = folder / "images"
    images.mkdir(parents=True)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (height + 64, width + 64, 3), np.uint8)
    grain = cv2.GaussianBlur(noise, (0, 0), 2)
    files = []
    for k in range(2 * FPS):
        files.append(images / f"{k:06d}.jpg")
        cv2.imwrite(str(files[-1]), grain[k % 64 :, k % 64 :][:height, :width])
    for k in range(len(files), round(seconds * FPS)):
        (images / f"{k:06d}.jpg").symlink_to(files[k % len(files)].name)
    (folder / "replay.yaml").write_text("camera: images\ntelemetry:\n  - {file: compass.nmea}\n")
    times = np.arange(0.0, seconds, 0.02)
    lines = [f"{100 + t:.3f} {sentence(10 * t)}\n" for t in times]
    (folder / "compass.nmea").write_text("".join(lines))
    stamps = np.arange(round(seconds * FPS)) / FPS
    (images / "timestamps.txt").write_text("".join(f"{t:.6f}\n" for t in stamps))


def sentence(degrees: float) -> str:
    """An attitude of a Teledyne DVL."""
    body = f"PRDID,1.00,-2.00,{degrees % 360:.2f}"
    checksum = 0
    for letter in body.encode():
        checksum ^= letter
    return f"${body}*{checksum:02X}"


def record_and_kill(
    source: Path, out: Path, after_s: float, begun_bytes: int = FIRST_BYTES
) -> Killed:
    """Record ``source``, kill -9 ``after_s`` seconds after so many bytes are there."""
    script = Path(sys.executable).with_name("aquaflow")
    arguments = [str(script), "record", "--source", str(source), "--out", str(out)]
    process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + BEGUN_S
        while not under_way(out, begun_bytes):
            assert process.poll() is None, "the recorder ended by itself"
            assert time.monotonic() < deadline, "the recorder never began"
            time.sleep(0.02)
        began, cpu = time.monotonic(), cpu_s(process.pid)
        time.sleep(after_s)
        assert process.poll() is None, "the recorder ended before it was killed"
        used = cpu_s(process.pid) - cpu
        ended = time.monotonic()
    finally:
        process.kill()
        process.wait()
    return examined(out, ended - began, ended, used)


def examined(out: Path, ran_s: float, ended: float, used_s: float) -> Killed:
    """Replay all of what is there."""
    pictures = McapMessages(mcap_files(out)).of(lambda topic: topic.endswith("/image"))
    last_ns = max((message.log_ns for message in pictures), default=0)
    frames = list(McapCamera(out).frames())
    unreadable = sum(isinstance(frame, Dropped) for frame in frames)
    samples = sum(1 for _ in McapTelemetry(out).samples())
    lost_s = ended - last_ns * 1e-9
    share = used_s / ran_s if ran_s > 0.0 else 0.0
    return Killed(ran_s, lost_s, share, len(frames) - unreadable, samples, unreadable)


def under_way(out: Path, begun_bytes: int = FIRST_BYTES) -> bool:
    """True once pictures are on the disk."""
    return out.is_dir() and any(file.stat().st_size > begun_bytes for file in mcap_files(out))


def cpu_s(pid: int) -> float:
    """User and system time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
