"""What the pictures themselves say of a trajectory, and of its ground truth.

Keypoints of the recording's pictures at their full width are matched between moments far apart;
neither the dive nor the truth has used these matches. Each match must lie on the epipolar line that
the relative pose gives, whatever the depth. Where the truth's distances are larger than the dive's,
the truth is the worse trajectory of the two; the relative pose that fits each pair on its own best
shows how small they can be.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import MIN_MATCHES, epipolar_distances, relative_pose
from aquaflow.lab.evaluation.dive_files import evaluated_dive
from aquaflow.lab.evaluation.trajectory_error import ASSOCIATION_TOLERANCE_S, Trajectory, associate
from aquaflow.lab.evaluation.truth import read_truth
from aquaflow.prior.contract import Keypoints
from aquaflow.prior.flow import normalised_grey
from aquaflow.prior.homography import detect
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.tracking.loops import match_keypoints
from aquaflow.types import Frame

Array = npt.NDArray[np.float64]

MOMENTS = 12
"""Pictures compared, evenly over the dive: 66 pairs."""
WIDEST_PX = 1440
"""Width that wider pictures are reduced to: three times that of tracking."""


@dataclass(frozen=True)
class GapError:
    """The pairs of pictures that are equally many moments apart; medians over their matches."""

    gap_s: float
    pairs: int
    matches: int
    dive_px: float
    truth_px: float | None
    """Null without a truth that has rotations."""
    best_px: float
    """Under the relative pose that fits each pair on its own."""


@dataclass(frozen=True)
class EpipolarError:
    """Epipolar distances, px of the pictures that were compared, by the time between them."""

    width_px: int
    gaps: list[GapError]

    def to_json(self) -> dict[str, Any]:
        """Stable keys."""
        return asdict(self)


@dataclass(frozen=True)
class _PosedKeypoints:
    """One picture's keypoints and the poses of that moment."""

    t_s: float
    camera: CameraModel
    keypoints: Keypoints
    T_wc: Sim3
    true_T_wc: Sim3 | None


def evaluate_epipolar(dive: Path, recording: Path, truth: Path | None) -> EpipolarError:
    """Compare the dive's trajectory, and the truth's if given, with matches of the pictures.

    Args:
        dive: the folder that a run wrote.
        recording: what was mapped.
        truth: as for the trajectory's error; one without rotations is left out.

    Raises:
        InputError: a file is missing or malformed, or the pictures do not match each other.
        ConfigError: the dive's crop or calibration does not fit the recording.
    """
    estimate = evaluated_dive(Dive(dive)).trajectory
    true = None if truth is None else read_truth(truth).trajectory
    if true is not None:
        ours, theirs = associate(estimate.t_s, true.t_s, ASSOCIATION_TOLERANCE_S)
        estimate, true = estimate.select(ours), true.select(theirs)
    if len(estimate) < 2:
        raise InputError(f"{dive} and its truth have fewer than two poses of the same moments")
    chosen = np.unique(np.linspace(0, len(estimate) - 1, MOMENTS).round().astype(int))
    estimate = estimate.select(chosen)
    true = None if true is None else true.select(chosen)
    moments = list(_moments(dive, recording, estimate, true))
    gaps = [_gap(moments, apart) for apart in range(1, len(moments))]
    found = [gap for gap in gaps if gap is not None]
    if not found:
        raise InputError(
            f"the pictures of {recording} at the dive's moments have fewer than {MIN_MATCHES} "
            "keypoints in common; give the recording that was mapped"
        )
    return EpipolarError(moments[0].camera.width, found)


def _moments(
    dive: Path, recording: Path, estimate: Trajectory, true: Trajectory | None
) -> Iterator[_PosedKeypoints]:
    """The recording's pictures at the times of the poses, prepared as the dive's but wider."""
    read = Dive(dive)
    source, calibration = read.config.source, read.calibration
    opened, prepare = open_recording(recording), None
    try:
        for frame in opened.frames(source.every, source.start, source.stop):
            if not isinstance(frame, Frame):
                continue
            row = int(np.argmin(np.abs(estimate.t_s - frame.t_ns * 1e-9)))
            if abs(estimate.t_s[row] - frame.t_ns * 1e-9) > ASSOCIATION_TOLERANCE_S:
                continue
            width = min(frame.image.shape[1], WIDEST_PX)
            wider = source.model_copy(update={"width": width})
            prepare = prepare or Preparation(wider, calibration)
            prepared = prepare(frame)
            camera = prepared.camera
            if calibration is None:  # what the dive found
                camera = read.camera.resize(camera.width, camera.height)
            yield _PosedKeypoints(
                float(estimate.t_s[row]),
                camera,
                detect(normalised_grey(prepared.image)),
                _pose(estimate, row),
                None if true is None else _pose(true, row),
            )
    finally:
        opened.close()


def _pose(trajectory: Trajectory, row: int) -> Sim3:
    return Sim3(trajectory.R_wc[row], trajectory.positions[row])


def _gap(moments: list[_PosedKeypoints], apart: int) -> GapError | None:
    """All pairs that are ``apart`` moments apart; None if no pair has enough matches."""
    pairs = [
        pair
        for i, j in combinations(range(len(moments)), 2)
        if j - i == apart and (pair := _distances(moments[i], moments[j])) is not None
    ]
    if not pairs:
        return None
    dive, best, true = (np.concatenate(column) for column in zip(*pairs, strict=True))
    seconds = [after.t_s - moments[i].t_s for i, after in enumerate(moments[apart:])]
    known = bool(np.isfinite(true).all())
    return GapError(
        float(np.mean(seconds)),
        len(pairs),
        len(dive),
        float(np.median(dive)),
        float(np.median(true)) if known else None,
        float(np.median(best)),
    )


def _distances(a: _PosedKeypoints, b: _PosedKeypoints) -> tuple[Array, Array, Array] | None:
    """[M] px each: under the dive's relative pose, under the best one, and under the truth's (NaN
    without one); None where too few keypoints match."""
    in_a, in_b = match_keypoints(a.keypoints, b.keypoints)
    if len(in_a) < MIN_MATCHES:
        return None
    pixels_a = a.keypoints.pixels[in_a].astype(np.float64)
    pixels_b = b.keypoints.pixels[in_b].astype(np.float64)
    best = relative_pose(pixels_a, pixels_b, a.camera, b.camera)
    if best is None:
        return None
    rays_a, rays_b = a.camera.unproject(pixels_a), b.camera.unproject(pixels_b)

    def under(T_ba: Sim3) -> Array:
        return b.camera.fx * epipolar_distances(rays_a, rays_b, T_ba)

    true = np.full(len(in_a), np.nan)
    if a.true_T_wc is not None and b.true_T_wc is not None:
        true = under(b.true_T_wc.inverse() @ a.true_T_wc)
    return under(b.T_wc.inverse() @ a.T_wc), under(best), true
