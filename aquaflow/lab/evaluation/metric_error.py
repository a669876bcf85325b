"""How true a dive's metres, gravity and north are, and whether its stated sigmas are.

The estimate is the dive's trajectory as written, in n; nothing is taken from the truth but what
each number says. The truth must have z down for gravity and heading, as synthetic dives have.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.dive.dive import Dive
from aquaflow.dive.medium import Medium, Rgb
from aquaflow.lab.evaluation.trajectory_error import Trajectory
from aquaflow.lab.synthetic.water import WATER_TYPES
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
        """The errors as plain values with the names above."""
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


# --------------------------------------------------------------------------------------------------
# How well the water was recovered: the dive's ``medium.json`` against a synthetic dive's truth.
#
# The water is ``I = J exp(-beta_a z) + B_inf (1 - exp(-b z)) + B_res exp(-d z)`` with the range z.
# A dive of unknown scale has its rates per map unit; the trajectory's alignment (truth = scale x
# map) takes them to rates per metre.

BACKSCATTER_SPAN_M = (0.5, 8.0)
"""Ranges over which the two backscatter curves are compared: a hand's width to turbid distance."""

BACKSCATTER_SAMPLES = 64
"""Ranges, evenly spaced over the span, at which the curves are compared."""


@dataclass(frozen=True)
class MediumError:
    """Recovered water against true water."""

    attenuation_per_m: list[float]
    """[3] recovered, per metre of the truth."""
    true_attenuation_per_m: list[float]
    attenuation_ratio: list[float | None]
    """[3] recovered over true; null where the truth is zero."""
    backscatter_rmse: float
    """Between the curves B(z), in units of image brightness, over ``backscatter_span_m``.

    The curves are compared, not their parameters: b and d of two curves that agree can differ."""
    backscatter_span_m: tuple[float, float]
    B_inf_error: list[float]
    """[3] recovered minus true."""
    active: bool
    """False if the dive found the water clear and modelled none."""

    def to_json(self) -> dict[str, Any]:
        """The errors as plain values with the names above."""
        return asdict(self)


def compare_medium(recovered: Medium, truth: Medium, *, active: bool) -> MediumError:
    """Compare two waters whose rates are per metre."""
    ratio = [
        found / true if true > 0.0 else None
        for found, true in zip(recovered.beta_a, truth.beta_a, strict=True)
    ]
    z = np.linspace(*BACKSCATTER_SPAN_M, BACKSCATTER_SAMPLES)
    difference = recovered.backscatter(z) - truth.backscatter(z)
    return MediumError(
        attenuation_per_m=list(recovered.beta_a),
        true_attenuation_per_m=list(truth.beta_a),
        attenuation_ratio=ratio,
        backscatter_rmse=float(np.sqrt(np.mean(difference**2))),
        backscatter_span_m=BACKSCATTER_SPAN_M,
        B_inf_error=(np.array(recovered.B_inf) - np.array(truth.B_inf)).tolist(),
        active=active,
    )


def recovered_water(dive: Dive, metres_per_unit: float) -> tuple[Medium, bool]:
    """The water of a dive with rates per metre, and whether one was modelled; without, clear water.

    Args:
        dive: ``attenuation_unit`` of its medium.json names the unit of all its rates.
        metres_per_unit: scale of the alignment; not used if the dive's rates are per metre already.

    Raises:
        InputError: the file is not a dive's medium.
    """
    found = dive.medium
    if found is None:
        return WATER_TYPES["clear"], False
    if dive.medium_facts.get("attenuation_unit") == "1/m":
        return found, True
    per_metre = 1.0 / metres_per_unit
    rates = {name: _times(getattr(found, name), per_metre) for name in ("beta_a", "b", "d")}
    lamp = found.lamp and found.lamp.rescale(metres_per_unit)
    return replace(found, **rates, lamp=lamp), True


def _times(colour: Rgb, factor: float) -> Rgb:
    red, green, blue = (factor * each for each in colour)
    return red, green, blue
