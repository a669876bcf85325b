"""How true a dive's metres, gravity and north are, and whether its stated sigmas are.

The estimate is the dive's trajectory as written, in n; nothing is taken from the truth but what
each number says. The truth must have z down for gravity and heading, as synthetic dives have.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.lab.evaluation.trajectory import Trajectory
from aquaflow.telemetry.world_frame import WorldFrame

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class MetricError:
    """Null is what the dive does not state, or the truth does not know."""

    scale_error_pct: float
    """Estimated over true lengths, less 1; by the Sim(3) alignment."""
    scale_sigma_pct: float
    """As the dive states it, 1 sigma."""
    scale_error_sigmas: float | None
    """Error over the stated 1 sigma; null for a sigma of 0."""
    ate_rmse_m: float
    """After SE(3) alignment: no scale is taken from the truth."""
    gravity_error_deg: float | None = None
    gravity_sigma_deg: float | None = None
    gravity_error_sigmas: float | None = None
    """Angle between the two directions of z, of synthetic dives."""
    heading_error_deg: float | None = None
    heading_sigma_deg: float | None = None
    heading_error_sigmas: float | None = None
    """Mean turn about the vertical against the truth; only where x points to true north."""
    ate_rmse_m_level: float | None = None
    """After alignment by yaw and translation alone."""

    def to_json(self) -> dict[str, float | None]:
        """As plain values with the names above."""
        return asdict(self)


def metric_error(
    frame: WorldFrame,
    alignment_scale: float,
    ate_rmse_m: float,
    level: tuple[Trajectory, Trajectory] | None = None,
) -> MetricError | None:
    """Errors of a metric dive; None for one in map units.

    Args:
        frame: of the sub-map that is compared.
        alignment_scale: of the Sim(3) alignment, truth over estimate.
        ate_rmse_m: after SE(3) alignment.
        level: N poses of the estimate, in n, and of the truth at the same moments, in a world with
            z down; None where the truth has no such poses.
    """
    if not frame.metric:
        return None
    log_error = -np.log(alignment_scale)
    scale = MetricError(
        scale_error_pct=100.0 * float(np.expm1(log_error)),
        scale_sigma_pct=100.0 * frame.scale_sigma,
        scale_error_sigmas=_over(float(log_error), frame.scale_sigma),
        ate_rmse_m=ate_rmse_m,
    )
    if level is None or not frame.level:
        return scale
    estimate, truth = level
    R_tn = mean_rotation(truth.R_wc @ np.swapaxes(estimate.R_wc, 1, 2))
    tilt = float(np.arctan2(np.hypot(R_tn[0, 2], R_tn[1, 2]), R_tn[2, 2]))
    knows_north = frame.north == "true north"
    yaw = float(np.arctan2(R_tn[1, 0], R_tn[0, 0])) if knows_north else None
    return MetricError(
        scale.scale_error_pct,
        scale.scale_sigma_pct,
        scale.scale_error_sigmas,
        ate_rmse_m,
        gravity_error_deg=float(np.degrees(tilt)),
        gravity_sigma_deg=float(np.degrees(frame.tilt_sigma_rad)),
        gravity_error_sigmas=_over(tilt, frame.tilt_sigma_rad),
        heading_error_deg=None if yaw is None else float(np.degrees(-yaw)),
        heading_sigma_deg=float(np.degrees(frame.heading_sigma_rad)) if knows_north else None,
        heading_error_sigmas=None if yaw is None else _over(-yaw, frame.heading_sigma_rad),
        ate_rmse_m_level=level_error(estimate.positions, truth.positions),
    )


def _over(error: float, sigma: float) -> float | None:
    return error / sigma if sigma > 0.0 else None


def mean_rotation(
    rotations: Array,  # [N, 3, 3]
) -> Array:
    """The rotation [3, 3] with the least sum of squared differences from all."""
    return np.asarray(Rotation.from_matrix(rotations).mean().as_matrix())


def level_error(
    estimate: Array,  # [N, 3] m, z down
    truth: Array,  # [N, 3] m, z down
) -> float:
    """RMS distance, m, after the best turn about the vertical and the best translation."""
    x, y = estimate - estimate.mean(axis=0), truth - truth.mean(axis=0)
    across = (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum()
    yaw = np.arctan2(across, (x[:, :2] * y[:, :2]).sum())
    turned = Rotation.from_euler("z", yaw).apply(x)
    return float(np.sqrt(((turned - y) ** 2).sum(axis=1).mean()))
