"""How the body moved between two frames, by gyro and DVL: what tracking expects of the next one."""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import on_so3, so3_exp
from aquaflow.types import AngularRate, TelemetrySample, Velocity

Array = npt.NDArray[np.float64]

KEPT_S = 5.0
"""s of samples that are kept: frames are closer together, or nothing is expected of them."""
HELD_S = 0.15
"""s for which the newest value stands for what has not arrived yet: links are so late at most."""
HELD_VELOCITY_S = 0.6
"""The same of a DVL, which sends 4 to 15 values a second."""


class RecentMotion:
    """The last seconds of every gyro and DVL."""

    def __init__(self) -> None:
        self._rates: dict[str, deque[tuple[float, Array]]] = {}
        self._velocities: dict[str, deque[tuple[float, Array]]] = {}

    def add(self, sample: TelemetrySample) -> None:
        """Keep a rate or a velocity; other samples say nothing about motion."""
        if isinstance(sample, AngularRate):
            _keep(self._rates, sample.source, sample.t_ns, np.array(sample.rate_rad_s))
        elif isinstance(sample, Velocity):
            _keep(self._velocities, sample.source, sample.t_ns, np.array(sample.velocity_m_s))

    def turn(self, first_s: float, last_s: float) -> Array | None:
        """R_b0b1 [3, 3], from the body at the later moment to the body at the earlier one.

        None where no gyro covers the time.
        """
        for samples in self._rates.values():
            pieces = _between(samples, first_s, last_s, HELD_S)
            if pieces is not None:
                R = np.eye(3)
                for duration_s, rate in pieces:
                    R = R @ so3_exp(duration_s * rate)
                return on_so3(R)
        return None

    def displacement(self, first_s: float, last_s: float) -> Array | None:
        """[3] m, displacement of the body's origin in its axes on the way; None without a DVL.

        The turn within the time is left out: it is a few degrees between two frames.
        """
        for samples in self._velocities.values():
            pieces = _between(samples, first_s, last_s, HELD_VELOCITY_S)
            if pieces is not None:
                return np.asarray(sum(duration_s * velocity for duration_s, velocity in pieces))
        return None


def _keep(
    kept: dict[str, deque[tuple[float, Array]]],  # s and [3] of each source
    source: str,
    t_ns: int,
    value: Array,  # [3]
) -> None:
    samples = kept.setdefault(source, deque())
    t_s = t_ns * 1e-9
    if samples and t_s <= samples[-1][0]:
        return  # late, or the clock was set back
    samples.append((t_s, value))
    while samples[0][0] < t_s - KEPT_S:
        samples.popleft()


def _between(
    samples: deque[tuple[float, Array]],  # s and [3]
    first_s: float,
    last_s: float,
    held_s: float,
) -> list[tuple[float, Array]] | None:
    """Durations and values [3] that fill the time; None where a gap is longer than ``held_s``."""
    pieces: list[tuple[float, Array]] = []
    at = first_s
    value: Array | None = None
    for t_s, new in samples:
        if t_s > at and value is not None:
            until = min(t_s, last_s)
            if until - at > held_s:
                return None
            pieces.append((until - at, 0.5 * (value + new)))
            at = until
        if at >= last_s:
            return pieces
        if t_s <= at:
            value = new if at - t_s <= held_s else None
    if value is None or last_s - samples[-1][0] > held_s:
        return None
    return [*pieces, (last_s - at, samples[-1][1])]
