"""An hour's slow dive, and instruments with chosen errors."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.mounting import mountings_of
from aquaflow.lab.synthetic.path import plan_path
from aquaflow.lab.synthetic.telemetry.series import Constants, draw_constants
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise
from tests.lab.synthetic.without_errors import WITHOUT_ERRORS

Array = npt.NDArray[np.float64]

HOUR = SyntheticConfig(frames=3600, fps=1.0, speed_m_s=0.02)


@cache
def motion_of_an_hour() -> TrueBodyMotion:
    """Over a flat floor, without a relief to follow."""
    return TrueBodyMotion(plan_path(HOUR, np.random.default_rng(0)), mountings_of(HOUR))


def only(**errors: float) -> TelemetryNoise:
    """These errors and no others."""
    return TelemetryNoise.model_validate({**WITHOUT_ERRORS, **errors})


def constants_of(noise: TelemetryNoise, seed: int = 0) -> Constants:
    return draw_constants(SyntheticConfig(seed=seed, telemetry=noise))


def times(hz: float) -> Array:
    return np.arange(int(3590 * hz)) / hz
