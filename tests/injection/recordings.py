"""The tiny recordings that the dives are made from; written by processes of their own."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

FRAMES = 14
WIDTH, HEIGHT = 128, 96
ELSEWHERE = 3
"""Pictures of another place, after which the first one is seen again."""


def write_recordings(folder: Path) -> None:
    """``pictures``, ``return`` (a loss, and the place found again), ``video.avi`` and ``mcap``."""
    size = ("--width", WIDTH, "--height", HEIGHT)
    _aquaflow("lab", "synth", folder / "pictures", "--frames", FRAMES, *size)
    _aquaflow("lab", "synth", folder / "wall", "--scene", "wall", "--frames", 40, *size)
    here = sorted((folder / "pictures").rglob("*.png"))[:FRAMES]
    wall = sorted((folder / "wall").rglob("*.png"))[:ELSEWHERE]
    _write_return(folder / "return", [*here[:9], *wall, *here[5:9]])
    _write_video(folder / "video.avi", here)
    _aquaflow("record", "--source", folder / "pictures", "--out", folder / "mcap")


def _write_return(folder: Path, pictures: list[Path]) -> None:
    folder.mkdir()
    for i, picture in enumerate(pictures):
        shutil.copy(picture, folder / f"{i:04d}.png")


def _write_video(path: Path, pictures: list[Path]) -> None:
    import cv2

    code = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), code, 10.0, (WIDTH, HEIGHT))
    for picture in pictures:
        writer.write(cv2.imread(str(picture)))
    writer.release()


def _aquaflow(*arguments: object) -> None:
    script = Path(sys.executable).with_name("aquaflow")
    subprocess.run([script, *map(str, arguments)], check=True, capture_output=True)
