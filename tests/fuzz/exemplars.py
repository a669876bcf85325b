"""One small valid example of every kind of file and folder that AquaFlow reads or writes."""

from __future__ import annotations

import os
import shutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import yaml

from .child import Ended, Limits, run_forked
from .log_exemplars import write_bag, write_logs

WIDTH, HEIGHT, FRAMES = 96, 72, 10
MAKING = Limits(interrupt_s=None, hang_s=300.0)

VEHICLE = {
    "cameras": {"front": {"kind": "v4l2", "device": "none", "first_retry_s": 0.1}},
    "telemetry": {
        "devices": {
            "sounder": {"kind": "nmea0183", "link": {"kind": "serial", "port": "missing"}},
            "autopilot": {
                "kind": "mavlink",
                "mounting": {"position_m": [0.1, 0.0, -0.2], "yaw_deg": 90.0},
                "link": {"kind": "tcp", "host": "127.0.0.1", "port": 1},
            },
        }
    },
    "recording": {"picture": "jpeg"},
    "service": {
        "health": {"enabled": False, "host": "127.0.0.1", "port": 8990},
        "checkpoint": {"every_s": 0.2},
        "mapping": {"refine_seconds": 0.2},
        "limits": {"disk_mb": 0},
    },
    "viewer": {"enabled": False, "port": 8991},
    "mapping": {"optimiser": {"steps_keyframe": 2, "refine_steps": 2}},
}

README = "# Title\n<!-- bench: begin -->\nold\n<!-- bench: end -->\nrest\n"

FISHEYE = {
    "width": WIDTH, "height": HEIGHT, "model": "pinhole", "fx": 80.0, "fy": 80.0, "cx": 48.0,
    "cy": 36.0, "distortion_model": "fisheye", "distortion": [0.01, 0.0, 0.0, 0.0],
}  # fmt: skip


class ExemplarError(Exception):
    """An example could not be made."""


def make_exemplars(root: Path) -> tuple[str, ...]:
    """Fill ``root``; the names of what is there now."""
    from aquaflow.cli import main

    aquaflow = [
        [
            "lab",
            "synth",
            "recording",
            f"--frames={FRAMES}",
            f"--width={WIDTH}",
            f"--height={HEIGHT}",
        ],
        ["map", "recording", "--out=dive", "--refine-steps=3"],
        ["record", "--source=recording", "--out=recorded", "--seconds=1"],
        ["site", "add", "site", "dive"],
        ["site", "merge", "site"],
    ]
    for argv in aquaflow:
        _done(run_forked(main, ["aquaflow", *argv], root, MAKING), argv)
    for make in (_write_files, write_logs, write_bag, _write_media, _write_killed):
        _done(run_forked(_in_folder(make), ["make"], root, MAKING), [make.__name__])
    return tuple(sorted(path.name for path in root.iterdir()))


def _done(ended: Ended, what: list[str]) -> None:
    if ended.code != 0:
        raise ExemplarError(f"{' '.join(what)} ended with {ended.code}: {ended.err}")


def _in_folder(make: Callable[[Path], None]) -> Callable[[], None]:
    return lambda: make(Path())


def _write_files(root: Path) -> None:
    import torch

    from aquaflow.config import Config
    from aquaflow.prior.factory import SHIPPED

    shutil.copy(root / "recording" / "camera.yaml", root)
    shutil.copy(root / "recording" / "poses.tum", root)
    (root / "fisheye.yaml").write_text(yaml.safe_dump(FISHEYE))
    settings = Config().model_dump(mode="json")
    settings["mapping"]["optimiser"]["refine_steps"] = 2
    (root / "config.yaml").write_text(yaml.safe_dump(settings))
    (root / "vehicle.yaml").write_text(yaml.safe_dump(VEHICLE))
    rows = [f"{k:06d}.png,{k * 0.1},{k * 0.2}" for k in range(FRAMES)]
    (root / "positions.csv").write_text("\n".join(["file,easting_m,northing_m", *rows, ""]))
    (root / "token").write_text("0123456789abcdef0123456789abcdef\n")
    (root / "README.md").write_text(README)
    torch.save({"model": {"a.weight": torch.zeros(3, 3)}}, root / "weights.pth")
    (root / "prior").mkdir()
    for name in ("prior.json", "encoder.onnx", "decoder.onnx", "encoder_int8.onnx"):
        shutil.copy(SHIPPED / name, root / "prior")


def _write_media(root: Path) -> None:
    import cv2

    files = sorted((root / "recording" / "images").glob("*.png"))
    pictures = [cv2.imread(str(file)) for file in files]
    for name, codec in (("clip.mp4", "mp4v"), ("clip.avi", "MJPG")):
        code = cv2.VideoWriter.fourcc(*codec)
        writer = cv2.VideoWriter(str(root / name), code, 10.0, (WIDTH, HEIGHT))
        for picture in pictures:
            writer.write(picture)
        writer.release()
    for folder, suffix in (("pictures", "jpg"), ("tiff", "tiff")):
        (root / folder).mkdir()
        for number, picture in enumerate(pictures):
            cv2.imwrite(str(root / folder / f"{number}.{suffix}"), picture)
    (root / "pictures" / "timestamps.txt").write_text(
        "".join(f"{number}.jpg {number / 10:.1f}\n" for number in range(FRAMES))
    )


def _write_killed(root: Path) -> None:
    """A live dive without an end: killed when its first checkpoint is there."""
    from aquaflow.cli import main

    state = root / "killed" / "checkpoint" / "state.npz"
    argv = ["aquaflow", "run", "--source=recording", "--config=vehicle.yaml", "--out=killed"]
    sys.argv = [*argv, "--speed=0.05"]

    def kill() -> None:
        while not state.exists():
            time.sleep(0.05)
        time.sleep(0.5)
        os._exit(0)

    threading.Thread(target=kill, daemon=True).start()
    main()
    raise ExemplarError("the dive that should be killed ended by itself")
