"""Trajectory errors: absolute (ATE), relative (RPE) and drift.

Definitions after J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS
2012. Distances are in the truth's unit: metres if the truth is metric, arbitrary if it comes from
structure from motion, which is why every distance is also given as a percentage of the path.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.dive.tum import ASSOCIATION_TOLERANCE_S, Trajectory, associate, read_tum
from aquaflow.geometry.alignment import Alignment, align

Positions = npt.NDArray[np.float64]


@dataclass(frozen=True)
class AbsoluteError:
    """Root mean square distance of aligned positions, and how they were aligned."""

    rmse: float
    """Truth's unit."""
    pct: float
    """Percent of the path length."""
    alignment: Alignment


@dataclass(frozen=True)
class RelativeError:
    """Error of the motion between successive common poses; map distances scaled by Sim(3)."""

    translation_rmse: float
    """Truth's unit per pair."""
    translation_pct: float | None
    """RMS error over RMS step, percent; null if the truth does not move."""
    rotation_rmse_deg: float
    pairs: int

    def to_json(self) -> dict[str, float | int | None]:
        """The errors as plain values with the names above."""
        return asdict(self)


@dataclass(frozen=True)
class TrajectoryError:
    """Every error of one trajectory against its truth."""

    matched: int
    path_length: float
    """Of the truth, between the first and the last common pose, truth's unit."""
    se3: AbsoluteError
    sim3: AbsoluteError
    relative: RelativeError | None
    """Null where the truth has positions only."""
    rotation_rmse_deg: float | None
    """After Sim(3) alignment; null if the truth has no rotations or the path is a straight line."""
    drift_pct: float | None
    """Gap between the last positions once the first poses are made equal, percent of the path."""


def absolute_error(
    estimate: Positions,  # [N, 3]
    truth: Positions,  # [N, 3]
    path_length: float,
    *,
    with_scale: bool,
) -> AbsoluteError:
    """ATE after rigid (SE(3)) or, ``with_scale``, similarity (Sim(3)) alignment.

    Raises:
        InputError: the positions cannot be aligned.
    """
    alignment = align(estimate, truth, with_scale=with_scale)
    squared = ((alignment.T_target_source.apply(estimate) - truth) ** 2).sum(axis=1)
    rmse = float(np.sqrt(squared.mean()))
    return AbsoluteError(rmse, 100.0 * rmse / path_length, alignment)


def position_error(
    estimate: Positions,  # [N, 3]
    truth: Positions,  # [N, 3]
    path_length: float,
) -> TrajectoryError:
    """The errors that need positions only.

    Raises:
        InputError: the positions cannot be aligned.
    """
    return TrajectoryError(
        matched=len(truth),
        path_length=path_length,
        se3=absolute_error(estimate, truth, path_length, with_scale=False),
        sim3=absolute_error(estimate, truth, path_length, with_scale=True),
        relative=None,
        rotation_rmse_deg=None,
        drift_pct=None,
    )


def horizontal_error(
    estimate: Trajectory,
    truth: Positions,  # [N, 2] easting, northing
) -> float:
    """RMS distance in the horizontal, truth's unit; the estimate's own heights do not count.

    The vertical is the mean viewing direction, since such a truth is of pictures taken from above;
    the rest is a similarity of the plane: heading, scale and two shifts.
    """
    down = estimate.R_wc[:, :, 2].mean(axis=0)
    level = Rotation.align_vectors([[0.0, 0.0, 1.0]], [down])[0]
    forward_right = level.apply(estimate.positions)[:, :2]
    # Seen from below x and y change places, so that both turn the same way.
    p = forward_right @ (1.0, 1.0j)
    q = truth @ (1.0j, 1.0)
    p, q = p - p.mean(), q - q.mean()
    scale = np.vdot(p, q) / max(float(np.vdot(p, p).real), np.finfo(float).tiny)
    return _rms(np.abs(scale * p - q))


def trajectory_error(
    estimate: Trajectory, truth: Trajectory, path_length: float
) -> TrajectoryError:
    """All errors of ``estimate`` against ``truth``: N poses each, already associated.

    Raises:
        InputError: the positions cannot be aligned.
    """
    sim3 = absolute_error(estimate.positions, truth.positions, path_length, with_scale=True)
    scale = sim3.alignment.T_target_source.scale
    first, last = np.array([0]), np.array([len(truth) - 1])
    gap, _ = _motion_error(estimate, truth, scale, first, last)
    turned = sim3.alignment.T_target_source.R @ estimate.R_wc
    absolute_deg = _angle_deg(np.swapaxes(truth.R_wc, 1, 2) @ turned)
    return TrajectoryError(
        matched=len(truth),
        path_length=path_length,
        se3=absolute_error(estimate.positions, truth.positions, path_length, with_scale=False),
        sim3=sim3,
        relative=relative_error(estimate, truth, scale),
        rotation_rmse_deg=None if sim3.alignment.collinear else _rms(absolute_deg),
        drift_pct=100.0 * float(gap[0]) / path_length,
    )


def relative_error(estimate: Trajectory, truth: Trajectory, scale: float) -> RelativeError:
    """RPE over successive poses; ``scale`` takes the estimate's unit to the truth's."""
    pairs = np.arange(len(truth) - 1)
    translation, rotation_deg = _motion_error(estimate, truth, scale, pairs, pairs + 1)
    step = _rms(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1))
    rmse = _rms(translation)
    return RelativeError(
        translation_rmse=rmse,
        translation_pct=100.0 * rmse / step if step > 0.0 else None,
        rotation_rmse_deg=_rms(rotation_deg),
        pairs=len(pairs),
    )


def _motion_error(
    estimate: Trajectory,
    truth: Trajectory,
    scale: float,
    i: npt.NDArray[np.intp],  # [P]
    j: npt.NDArray[np.intp],  # [P]
) -> tuple[Positions, Positions]:
    """Translation [P] (truth's unit) and rotation [P] (deg) of (T_i^-1 T_j)^-1 T_i^-1 T_j,
    truth first, estimate second.

    The translation is taken in camera i: turning it into camera j does not change its length.
    """
    R_est, R_true = estimate.R_wc, truth.R_wc
    moved_est = _in_camera(R_est[i], scale * (estimate.positions[j] - estimate.positions[i]))
    moved_true = _in_camera(R_true[i], truth.positions[j] - truth.positions[i])
    turned_est = np.swapaxes(R_est[i], 1, 2) @ R_est[j]
    turned_true = np.swapaxes(R_true[i], 1, 2) @ R_true[j]
    angle = _angle_deg(np.swapaxes(turned_true, 1, 2) @ turned_est)
    return np.linalg.norm(moved_est - moved_true, axis=1), angle


def _in_camera(
    R_wc: Positions,  # [P, 3, 3]
    vectors: Positions,  # [P, 3] world
) -> Positions:
    """World vectors [P, 3] in camera axes, with rotations [P, 3, 3]."""
    return np.asarray(np.einsum("pji,pj->pi", R_wc, vectors))


def _angle_deg(
    rotations: Positions,  # [P, 3, 3]
) -> Positions:
    """Turn angles [P] of rotations [P, 3, 3]; scipy's logarithm has no arccos to guard."""
    return np.asarray(np.degrees(Rotation.from_matrix(rotations).magnitude()))


def _rms(
    values: Positions,  # [P]
) -> float:
    return float(np.sqrt(np.mean(values**2)))


# --------------------------------------------------------------------------------------------------
# Trajectories of different sources, associated by time.

__all__ = ["ASSOCIATION_TOLERANCE_S", "Trajectory", "associate", "read_tum"]
