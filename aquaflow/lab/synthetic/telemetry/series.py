"""Random series: errors that wander, and samples that are missing."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.streams import instrument_stream

Array: TypeAlias = npt.NDArray[np.float64]
Mask: TypeAlias = npt.NDArray[np.bool_]


def wander(
    t: Array,  # [N] s, equal steps
    sigma: float,
    correlation_s: float,
    axes: int,
    rng: np.random.Generator,
) -> Array:
    """[N, axes] first-order Gauss-Markov processes with correlation exp(-dt / correlation_s)."""
    white = sigma * rng.standard_normal((len(t), axes))
    if len(t) < 2:
        return white
    kept = math.exp(-(t[1] - t[0]) / correlation_s)
    white[1:] *= math.sqrt(1.0 - kept**2)
    return np.asarray(lfilter([1.0], [1.0, -kept], white, axis=0))


def random_walk(
    t: Array,  # [N] s, equal steps
    rate: float,  # sigma gained per square root of a second
    axes: int,
    rng: np.random.Generator,
) -> Array:
    """[N, axes] random walks that begin at 0."""
    steps = rate * rng.standard_normal((len(t), axes))
    steps *= np.sqrt(np.diff(t, prepend=t[:1]))[:, None]
    return np.asarray(np.cumsum(steps, axis=0))


def choose(count: int, share: float, rng: np.random.Generator) -> Mask:
    """[count] True for single samples, a ``share`` of them on average."""
    return np.asarray(rng.uniform(size=count) < share)


def stretches(
    t: Array,  # [N] s
    per_min: float,
    mean_s: float,
    rng: np.random.Generator,
) -> Mask:
    """[N] True within stretches of exponential length that begin ``per_min`` times a minute."""
    inside = np.zeros(len(t), bool)
    if per_min == 0.0 or mean_s == 0.0 or len(t) == 0:
        return inside
    begin = t[0] + rng.exponential(60.0 / per_min)
    while begin <= t[-1]:
        end = begin + rng.exponential(mean_s)
        inside |= (t >= begin) & (t < end)
        begin = end + rng.exponential(60.0 / per_min)
    return inside


# --------------------------------------------------------------------------------------------------
# The errors of the instruments that are drawn once and stay for the whole dive.

Vector: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True)
class Constants:
    """One draw of every constant error; what a perfect estimator would find."""

    depth_offset_m: float
    """Measured depth minus true depth below the surface at the first picture, but for its wave."""
    tide_phase_rad: float
    """Of the cosine of the tide, at the first picture."""
    wave_phase_rad: float
    """Of the cosine of the surface wave, at the first picture."""
    heading_offset_deg: float
    """Measured heading minus true heading; positive clockwise as seen from above."""
    rate_bias_rad_s: Vector
    """Measured minus true rate per body axis at the first picture; it walks from there."""
    acceleration_bias_m_s2: Vector
    """Measured minus true specific force per body axis."""
    dvl_scale: float
    """Relative: measured velocity = (1 + dvl_scale) times the true one."""

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, by name."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


def draw_constants(config: SyntheticConfig) -> Constants:
    """The constants of a dive: another seed draws others, another sigma only scales them."""
    rng = instrument_stream(config.seed, "constants")
    noise = config.telemetry
    dvl, depth, heading = (float(draw) for draw in rng.standard_normal(3))
    rate, acceleration = rng.standard_normal((2, 3))
    tide, wave = (float(phase) for phase in rng.uniform(0.0, 2.0 * math.pi, 2))
    return Constants(
        depth_offset_m=noise.depth_offset_sigma_m * depth,
        tide_phase_rad=tide,
        wave_phase_rad=wave,
        heading_offset_deg=noise.heading_offset_sigma_deg * heading,
        rate_bias_rad_s=_scale(rate, noise.rate_bias_sigma_rad_s),
        acceleration_bias_m_s2=_scale(acceleration, noise.acceleration_bias_sigma_m_s2),
        dvl_scale=noise.dvl_scale_sigma * dvl,
    )


def _scale(
    draws: np.ndarray[Any, np.dtype[np.float64]],  # [3]
    sigma: float,
) -> Vector:
    x, y, z = (sigma * draws).tolist()
    return x, y, z
