"""How wrong a source's residuals are: white noise, and a part that varies slowly.

What limits telemetry is seldom its white noise: waves, the drift of an attitude filter, the drift
of the camera's own path pass slowly, and averaging does not remove them. Residuals r [N] of a
source are taken as r ~ N(0, diag((white sigma)^2) + slow^2 exp(-|dt| / time)), the stated sigma
times a factor and a first-order Gauss-Markov process. Factor, size and time are the likeliest for
the residuals, never better than the data sheet (Rasmussen and Williams, Gaussian Processes, 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

WHITE = np.geomspace(1.0, 32.0, 16)
"""Factors tried on the stated sigma; more than 32 is another instrument."""
SLOW = np.geomspace(1.0, 300.0, 25)
"""Sizes tried of the slow part, in units of its least."""


@dataclass(frozen=True)
class SlowPart:
    """What is known of a source's slow errors before any residual is seen."""

    least: float
    """1 sigma in the residual's unit, never taken to be smaller (data sheet)."""
    times_s: tuple[float, ...]
    """Correlation times that are possible, s."""


@dataclass(frozen=True)
class Noise:
    """The errors of one source."""

    white: float
    """Factor on the stated sigma."""
    slow: float
    """1 sigma, in the residual's unit."""
    time_s: float
    """Correlation time of the slow part."""

    def covariance(
        self,
        t_s: Array,  # [N] s
        sigma: Array,  # [N] stated, in the residual's unit
    ) -> Array:
        """[N, N] of one component of the residuals."""
        slow = self.slow**2 * np.exp(-np.abs(np.subtract.outer(t_s, t_s)) / self.time_s)
        return np.asarray(slow + np.diag((self.white * sigma) ** 2))


def likeliest(
    t_s: Array,  # [N] s
    r: Array,  # [N, D] residuals, D components of equal noise
    sigma: Array,  # [N]
    part: SlowPart,
) -> Noise:
    """The noise under which the residuals are likeliest."""
    best, found = -np.inf, Noise(1.0, part.least, part.times_s[0])
    slow = part.least * SLOW
    for time_s in part.times_s:
        process = np.exp(-np.abs(np.subtract.outer(t_s, t_s)) / time_s)
        values, vectors = np.linalg.eigh(process / np.outer(sigma, sigma))
        power = ((vectors.T @ (r / sigma[:, None])) ** 2).sum(axis=1)
        variance = (
            WHITE[:, None, None] ** 2
            + slow[None, :, None] ** 2 * np.maximum(values, 0.0)[None, None, :]
        )
        fit = -0.5 * (r.shape[1] * np.log(variance) + power / variance).sum(axis=2)
        i, j = np.unravel_index(int(np.argmax(fit)), fit.shape)
        if fit[i, j] > best:
            best, found = float(fit[i, j]), Noise(float(WHITE[i]), float(slow[j]), time_s)
    return found
