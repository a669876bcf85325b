"""A source's residuals as a function of the state, with their derivatives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from aquaflow.telemetry.noise import SlowPart
from aquaflow.telemetry.state import MetricState, P

Array = npt.NDArray[np.float64]

MOST = 250
"""Samples of one source that the estimator takes, evenly chosen: what is slow in their errors
limits the result, not how many there are."""
STEP = 1e-6
"""Of central differences, in m, rad and log-scale: halves the digits of float64."""


class Factor(ABC):
    """Residuals [N, D] of one source, in its own unit; zero where it agrees with the state."""

    kind: ClassVar[str]
    """Name of its message in a recording."""
    slow: SlowPart
    """Of the kind, or of this source."""
    spans: ClassVar[tuple[slice, ...]]
    """Parameters that the residuals depend on."""

    source: str
    t_s: Array
    """[N] s"""
    sigma: Array
    """[N] white noise, 1 sigma of each component."""

    @abstractmethod
    def residuals(self, state: MetricState) -> Array:
        """[N, D]"""

    def jacobian(self, state: MetricState) -> Array:
        """[N, D, P] derivatives by a step of the state, by central differences."""
        found = np.zeros((*self.residuals(state).shape, P))
        for span in self.spans:
            for k in range(span.start, span.stop):
                step = np.zeros(P)
                step[k] = STEP
                ahead, behind = (
                    self.residuals(state.move(step)),
                    self.residuals(state.move(-step)),
                )
                found[..., k] = (ahead - behind) / (2.0 * STEP)
        return found


def axes_along(
    vectors: Array,  # [N, 3]
) -> Array:
    """[N, 3, 3] unit vectors in rows: along each vector, and two across it."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    still = length < 1e-12
    along = np.where(still, [[1.0, 0.0, 0.0]], vectors / np.where(still, 1.0, length))
    helper = np.where(np.abs(along[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(along, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([along, first, np.cross(along, first)], axis=1)
