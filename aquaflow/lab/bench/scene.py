"""A scene of the benchmark: a recording, what is true about it, and how to open it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.lab.evaluation.restoration import SYNTHETIC_MARK
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.sources import open_recording
from aquaflow.types import Frame


@dataclass(frozen=True)
class BenchmarkScene:
    """Paths are strings, so that a scene travels to the worker as JSON."""

    name: str
    recording: str
    truth: str | None = None
    """What ``lab evaluate --truth`` takes; None: only time and held-out quality are measured."""
    calibration: str | None = None
    clean: str | None = None
    """The same recording without water."""
    clean_crop: str | None = None
    overrides: dict[str, Any] = field(default_factory=dict)
    """Of the config: the same for every contender."""
    refine_share: float = 1.0
    """Of a preset's refining steps: small pictures converge sooner."""

    def to_json(self) -> dict[str, Any]:
        """The scene as plain values."""
        return asdict(self)


def scene_at(path: Path) -> BenchmarkScene:
    """A recording or a synthetic dive that the user names.

    Raises:
        InputError: nothing is there.
    """
    if not path.exists():
        raise InputError(f"there is no scene at {path}; give a recording or a synthetic dive")
    if (path / SYNTHETIC_MARK).is_file():
        return BenchmarkScene(path.name, str(path), truth=str(path), clean=str(path))
    folder = path if path.is_dir() else path.parent
    calibration, truth = folder / "camera.yaml", truth_in(folder)
    return BenchmarkScene(
        path.stem,
        str(path),
        None if truth is None else str(truth),
        str(calibration) if calibration.is_file() else None,
    )


def truth_in(folder: Path) -> Path | None:
    """The folder's only trajectory, or else its only table of positions."""
    for pattern in ("poses*.tum", "*.tum", "positions*.csv"):
        found = sorted(folder.glob(pattern))
        if len(found) == 1:
            return found[0]
    return None


# --------------------------------------------------------------------------------------------------
# Suite ``real``: every clip folder of a data directory, with its ground truth.

VIDEOS = (".mp4", ".mov", ".avi", ".mkv")
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Suffixes by which a folder's videos and folders of pictures are found."""
SIDE_BY_SIDE = "side_by_side"
"""In a file's name: the left half is seen through water, the right half is the same without it."""

FEWEST_FRAMES = 40
"""A clip whose truth is sparse is thinned towards the truth's frames, but not below this."""


def real_scenes(data: Path) -> list[BenchmarkScene]:
    """One scene for every folder of ``data`` that holds a video or pictures.

    Raises:
        InputError: there is no such folder, or no clip in it.
    """
    if not data.is_dir():
        raise InputError(f"there is no data folder at {data}; give one with a folder for each clip")
    found = [scene_of_clip(folder) for folder in sorted(data.iterdir()) if folder.is_dir()]
    scenes = [scene for scene in found if scene is not None]
    if not scenes:
        raise InputError(f"no folder in {data} holds a video or pictures; give a folder of clips")
    return scenes


def scene_of_clip(folder: Path) -> BenchmarkScene | None:
    """The clip of a folder with what lies next to it; None without a video or pictures."""
    videos = sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEOS)
    pictures = any(path.suffix.lower() in PICTURES for path in folder.iterdir())
    if not videos and not pictures:
        return None
    recording = videos[0] if videos else folder
    truth, calibration = truth_in(folder), folder / "camera.yaml"
    source: dict[str, object] = {"every": _stride(recording, truth)}
    halves = SIDE_BY_SIDE in recording.name
    if halves:
        source["crop"] = "left"
    return BenchmarkScene(
        folder.name,
        str(recording),
        None if truth is None else str(truth),
        str(calibration) if calibration.is_file() else None,
        str(recording) if halves else None,
        "right" if halves else None,
        {"source": source},
    )


def _stride(recording: Path, truth: Path | None) -> int:
    """Every n-th frame, so that every frame with a truth is among them."""
    if truth is None or truth.suffix != ".tum":
        return 1
    try:
        source = open_recording(recording)
        try:
            count = source.frame_count or 0
            first = [f.t_ns * 1e-9 for f in islice(source.frames(), 3) if isinstance(f, Frame)]
        finally:
            source.close()
        known_s = read_tum(truth).t_s
    except AquaFlowError:
        return 1  # the run itself says what is wrong with the clip
    if len(first) < 2 or len(known_s) < 2:
        return 1
    apart = max(round(float(np.median(np.diff(known_s)) / np.median(np.diff(first)))), 1)
    fitting = [n for n in range(1, apart + 1) if apart % n == 0 and count / n >= FEWEST_FRAMES]
    return max(fitting, default=1)
