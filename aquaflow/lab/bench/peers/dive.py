"""What goes into a peer and what comes out: AquaFlow's prepared frames, a small dive folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import NotMappedError
from aquaflow.base.stages import pace
from aquaflow.base.storage.table import csv_text
from aquaflow.config import Config
from aquaflow.dive.tum import write_tum
from aquaflow.geometry.camera import load_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.bench.scene import BenchmarkScene
from aquaflow.lab.evaluation.dive_files import FRAME_COLUMNS
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.types import Frame

FEWEST_POSES = 3
"""As an alignment of the path with the truth needs."""


@dataclass(frozen=True)
class Prepared:
    """Undistorted frames at the width that is mapped, and their names in the recording."""

    frames: list[Frame]
    names: list[str]


@dataclass(frozen=True)
class PeerResult:
    """A peer's answer."""

    poses: dict[int, Sim3]
    """T_wc by position in the list of frames, in the peer's own unit."""
    wall_s: float
    first_pose_s: float
    frame_ms: list[float] = field(default_factory=list)
    """Empty for a peer that needs all frames before it places any."""
    features: str | None = None
    """What the peer matched, where it can do so in several ways."""


def prepared_frames(scene: BenchmarkScene, config: Config) -> Prepared:
    """Read and prepare the scene's frames as the pipeline does; that time is no peer's."""
    recording = open_recording(Path(scene.recording), fps=config.source.fps)
    calibration = None if scene.calibration is None else load_camera(Path(scene.calibration))
    prepare = Preparation(config.source, calibration or recording.camera)
    source = config.source
    try:
        frames = [
            prepare(frame)
            for frame in recording.frames(source.every, source.start, source.stop)
            if isinstance(frame, Frame)
        ]
        return Prepared(frames, [recording.name_of(frame.index) for frame in frames])
    finally:
        recording.close()


def write_dive(out: Path, recording: Prepared, result: PeerResult) -> dict[str, Any]:
    """Write trajectory.tum and frames.csv as ``aquaflow lab evaluate`` reads them; returns metrics.

    Raises:
        NotMappedError: too few frames have a pose.
    """
    frames = recording.frames
    if len(result.poses) < FEWEST_POSES:
        raise NotMappedError(f"{len(result.poses)} of {len(frames)} frames were placed")
    out.mkdir(parents=True, exist_ok=True)
    placed = sorted(result.poses)
    write_tum(
        out / "trajectory.tum",
        np.array([frames[i].t_ns * 1e-9 for i in placed]),
        np.stack([result.poses[i].t for i in placed]),
        np.stack([result.poses[i].quaternion for i in placed]),
    )
    rows: list[tuple[object, ...]] = [FRAME_COLUMNS]
    for i, (frame, name) in enumerate(zip(frames, recording.names, strict=True)):
        state = ("common", 0) if i in result.poses else ("lost", "")
        rows.append((frame.index, name, f"{frame.t_ns * 1e-9:.9f}", *state))
    (out / "frames.csv").write_text(csv_text(rows), encoding="utf-8", newline="")
    metrics = _metrics(len(frames), result)
    (out / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    return metrics


def _metrics(count: int, result: PeerResult) -> dict[str, Any]:
    return {
        "frames": count,
        "tracked": len(result.poses),
        "lost": count - len(result.poses),
        "wall_s": round(result.wall_s, 3),
        "fps": round(count / max(result.wall_s, 1e-9), 3),
        "features": result.features,
    } | pace(result.frame_ms, count, result.first_pose_s, result.wall_s)
