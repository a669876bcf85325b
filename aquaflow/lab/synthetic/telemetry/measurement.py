"""All instruments along one dive: their samples in the order of arrival."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.streams import Instrument, instrument_stream
from aquaflow.lab.synthetic.telemetry.altitude import altitude
from aquaflow.lab.synthetic.telemetry.constants import Constants
from aquaflow.lab.synthetic.telemetry.inertial import acceleration, angular_rate, attitude
from aquaflow.lab.synthetic.telemetry.position import position, utc_time
from aquaflow.lab.synthetic.telemetry.pressure import depth
from aquaflow.lab.synthetic.telemetry.sonar import Sonar
from aquaflow.lab.synthetic.telemetry.velocity import velocity
from aquaflow.recordings.sample_table import sample_of
from aquaflow.types import TelemetrySample

__all__ = ["SOURCE", "measure"]

Array: TypeAlias = npt.NDArray[np.float64]
Measure: TypeAlias = Callable[
    [Array, np.random.Generator], npt.NDArray[np.float64] | npt.NDArray[np.int64]
]
"""Times [N] s and the instrument's stream to values [N, K]; nan where it is silent."""

SOURCE = "synthetic"
"""The instruments' name in samples."""


def measure(
    config: SyntheticConfig, motion: TrueBodyMotion, sonar: Sonar, constants: Constants
) -> list[TelemetrySample]:
    """Samples of every instrument between the first picture and the last, by arrival.

    Times are nanoseconds since the first picture.
    """
    samples: list[TelemetrySample] = []
    noise, last = config.telemetry, (config.frames - 1) / config.fps
    for kind, (rate_hz, values_at) in _instruments(config, motion, sonar, constants).items():
        if rate_hz == 0.0:
            continue
        t = np.arange(int(last * rate_hz + 1e-9) + 1) / rate_hz
        rng = instrument_stream(config.seed, kind)
        late = rng.exponential(1.0, len(t)) * noise.latency_s
        # One device's messages arrive in the order in which they were sent.
        arrival = np.maximum.accumulate(t + late)
        values = values_at(t, rng)
        heard = np.isfinite(values).all(axis=1) & (t >= noise.starts_late_s)
        for k in np.flatnonzero(heard):
            t_ns, arrival_ns = round(float(t[k]) * 1e9), round(float(arrival[k]) * 1e9)
            samples.append(sample_of(kind, t_ns, arrival_ns, SOURCE, values[k].tolist()))
    return sorted(samples, key=lambda sample: sample.arrival_ns)


def _instruments(
    config: SyntheticConfig, motion: TrueBodyMotion, sonar: Sonar, constants: Constants
) -> dict[Instrument, tuple[float, Measure]]:
    """Rate (Hz; 0: not aboard) and measurement of each kind."""
    noise = config.telemetry
    known = (motion, constants, noise)
    return {
        "depth": (noise.depth_hz, lambda t, rng: depth(t, *known, rng)),
        "attitude": (noise.attitude_hz, lambda t, rng: attitude(t, *known, rng)),
        "angular_rate": (noise.rate_hz, lambda t, rng: angular_rate(t, *known, rng)),
        "acceleration": (noise.acceleration_hz, lambda t, rng: acceleration(t, *known, rng)),
        "velocity": (noise.dvl_hz, lambda t, rng: velocity(t, *known, rng)),
        "altitude": (noise.altitude_hz, lambda t, rng: altitude(t, motion, sonar, noise, rng)),
        "position": (noise.position_hz, lambda t, rng: position(t, motion, noise, rng)),
        "utc_time": (noise.utc_hz, lambda t, rng: utc_time(t, noise)),
    }
