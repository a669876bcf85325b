"""What those who look on may read of the service, in a dive and between dives."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from aquaflow.base.stages import Profiler
from aquaflow.live.health.degradation import Degradation
from aquaflow.live.health.state import Health
from aquaflow.types import Frame


class ServiceStatus(Protocol):
    """The live loop, or the standby between dives."""

    @property
    def health(self) -> Health:
        """State and reason."""
        ...

    @property
    def counters(self) -> Counters:
        """Counters of the present dive; between dives of nothing."""
        ...

    @property
    def degradation(self) -> Degradation:
        """How much is left out."""
        ...

    @property
    def picture(self) -> Frame | None:
        """The newest frame."""
        ...


# --------------------------------------------------------------------------------------------------
# Counters of the loop: its speed, the time of its stages, the results of the frames.

LAGS = 600
"""Frames whose lag is remembered: a minute at ten a second."""
WINDOW_S = 5.0
"""Window of the rates and shares."""
SLOW_MS = 500.0
"""Median lag of the last seconds beyond which the pilot is told; tracking then takes two pictures a
second, between which a vehicle swims a third of a picture at 0.5 m/s and 1.6 m altitude."""
AROUND = frozenset({"refine"})
"""Stages that are not part of the loop."""


class Counters:
    """Written by the loop; read by anyone."""

    def __init__(self, profiler: Profiler, now_s: Callable[[], float] = time.monotonic) -> None:
        self.frames = 0
        """Frames that were processed."""
        self.failures = 0
        """Frames whose processing raised an error; each was dropped."""
        self.classes: Counter[str] = Counter()
        """Frames by class."""
        self.fps = 0.0
        self.recent_lag_ms = 0.0
        """Median of the frames of the last window."""
        self.slow_s = 0.0
        """Of the windows in which that was more than ``SLOW_MS``."""
        self.slowest = ""
        """The stage with the most time in the last window."""
        self.shares: dict[str, float] = {}
        """Seconds per second in each stage, in the last window."""
        self._lags_ms: deque[float] = deque(maxlen=LAGS)
        self._profiler, self._now_s = profiler, now_s
        self._window = (now_s(), 0, profiler.totals_ms())

    def frame(self, arrival_ns: int, now_ns: int | None = None) -> float:
        """A frame was dealt with that had come at ``arrival_ns``; how long ago that is, in ms."""
        self.frames += 1
        now = time.monotonic_ns() if now_ns is None else now_ns
        lag_ms = (now - arrival_ns) * 1e-6
        self._lags_ms.append(lag_ms)
        return lag_ms

    def update(self) -> None:
        """Compute rates and shares, once a window of ``WINDOW_S``."""
        now, (since, frames, totals) = self._now_s(), self._window
        if now - since < WINDOW_S:
            return
        current = self._profiler.totals_ms()
        spent = {
            name: current[name] - totals.get(name, 0.0) for name in current if name not in AROUND
        }
        self.fps = (self.frames - frames) / (now - since)
        recent = list(self._lags_ms)[max(frames - self.frames, -LAGS) :]
        self.recent_lag_ms = float(np.median(recent)) if self.frames > frames else 0.0
        self.slow_s += now - since if self.slow else 0.0
        self.shares = {name: 1e-3 * ms / (now - since) for name, ms in spent.items() if ms > 0.0}
        self.slowest = max(self.shares, key=lambda name: self.shares[name], default="")
        self._window = (now, self.frames, current)

    @property
    def slow(self) -> bool:
        """True while tracking falls behind, whatever gives way to it."""
        return self.recent_lag_ms > SLOW_MS

    def lag_ms(self) -> dict[str, float | None]:
        """From a frame's arrival to its pose: median, 95th percentile and longest of the last
        ``LAGS`` frames."""
        lags = list(self._lags_ms)
        if not lags:
            return dict.fromkeys(("p50", "p95", "max"))
        values = np.percentile(lags, (50, 95, 100))
        return {
            name: round(float(value), 1)
            for name, value in zip(("p50", "p95", "max"), values, strict=True)
        }

    def to_json(self) -> dict[str, Any]:
        """For /health: counts, frames per second, times in ms."""
        return {
            "frames": self.frames,
            "failures": self.failures,
            "classes": dict(self.classes),
            "fps": round(self.fps, 2),
            "lag_ms": self.lag_ms(),
            "slowest_stage": self.slowest,
            "stage_shares": {name: round(share, 3) for name, share in self.shares.items()},
        }
