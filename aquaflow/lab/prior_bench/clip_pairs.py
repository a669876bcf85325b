"""Pairs of a real clip whose poses are known, at several distances in time.

Of such a pair only the epipolar line of a match is known, not the place on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.config import Config, parse_config
from aquaflow.config.presets import merged
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.bench.peers.dive import prepared_frames
from aquaflow.lab.bench.real_suite import scene_of_clip
from aquaflow.lab.evaluation.trajectory import ASSOCIATION_TOLERANCE_S, associate, read_tum
from aquaflow.lab.prior_bench.pair import KnownPair
from aquaflow.types import Frame

TRUTH, CALIBRATION = "poses_sfm.tum", "camera.yaml"
"""Files of a clip's folder that are needed."""
SPACINGS = (1, 4, 8, 16)
"""Between the two pictures, in poses of the truth."""


def clip_pairs(folder: Path, count: int) -> list[KnownPair]:
    """Up to ``count`` pairs of each spacing, evenly over the clip.

    Raises:
        InputError: the folder holds no clip, no calibration or no poses.
    """
    scene = scene_of_clip(folder) if folder.is_dir() else None
    missing = [name for name in (TRUTH, CALIBRATION) if not (folder / name).is_file()]
    if scene is None or missing:
        lacking = " and ".join(missing) or "video or pictures"
        raise InputError(f"{folder} has no {lacking}; give the folder of a clip with its poses")
    config = parse_config(merged(Config().model_dump(), scene.overrides), str(folder))
    frames, truth = prepared_frames(scene, config).frames, read_tum(folder / TRUTH)
    ours, theirs = associate(
        np.array([frame.t_ns * 1e-9 for frame in frames]), truth.t_s, ASSOCIATION_TOLERANCE_S
    )
    known = [
        (frames[i], Sim3(truth.R_wc[j], truth.positions[j]))
        for i, j in zip(ours, theirs, strict=True)
    ]
    return [pair for n in SPACINGS for pair in _spaced(folder.name, known, n, count)]


def _spaced(
    name: str, known: Sequence[tuple[Frame, Sim3]], spacing: int, count: int
) -> list[KnownPair]:
    both = list(zip(known, known[spacing:], strict=False))
    if not both:
        return []
    apart_s = float(np.median([b.t_ns - a.t_ns for (a, _), (b, _) in both])) * 1e-9
    chosen = np.unique(np.linspace(0, len(both) - 1, min(count, len(both))).round().astype(int))
    return [
        KnownPair(
            f"{name}, {apart_s:.2f} s", a.image, b.image, a.camera, b.camera,
            T_ba=T_wb.inverse() @ T_wa,
        )
        for (a, T_wa), (b, T_wb) in (both[i] for i in chosen)
    ]  # fmt: skip
