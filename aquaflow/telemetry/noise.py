"""How wrong a source's residuals are: white noise, and parts that last.

What limits telemetry is seldom its white noise: waves, the drift of an attitude filter, the drift
of the camera's own path pass slowly, and averaging does not remove them. The residuals r [N] of a
source are taken as Gaussian with the covariance

    white^2 (diag(sigma^2) + least^2 exp(-|dt| / long))
        + size^2 exp(-|dt| / time) cos(2 pi dt / period)

where sigma and the least slow part are the data sheet's, and what comes on top is the likeliest of
some processes: Gauss-Markov of several times, and waves of several periods, which average out over
a few of them (Rasmussen and Williams, Gaussian Processes for Machine Learning, 4.2 and 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cholesky, solve_triangular

Array = npt.NDArray[np.float64]

WHITE = np.geomspace(1.0, 32.0, 16)
"""Factors tried on the data sheet's noise; more than 32 is another instrument."""
SIZES = np.concatenate([[0.0], np.geomspace(0.3, 300.0, 28)])
"""Sizes tried of the process on top, in root mean squares of the data sheet's noise."""


@dataclass(frozen=True)
class Process:
    """A kind of error that lasts."""

    time_s: float
    """Correlation time."""
    period_s: float = np.inf
    """Of a wave; infinite for a drift."""

    def correlation(
        self,
        t_s: Array,  # [N] s
    ) -> Array:
        """[N, N]"""
        dt = np.abs(np.subtract.outer(t_s, t_s))
        return np.asarray(np.exp(-dt / self.time_s) * np.cos(2.0 * np.pi * dt / self.period_s))


@dataclass(frozen=True)
class SlowPart:
    """What is known of a source's lasting errors before any residual is seen."""

    least: float
    """1 sigma of a drift that is always there, in the residual's unit (data sheet)."""
    time_s: float
    """Its correlation time."""
    processes: tuple[Process, ...]
    """What may come on top."""

    def base(
        self,
        t_s: Array,  # [N] s
        sigma: Array,  # [N] white, in the residual's unit
    ) -> Array:
        """[N, N] covariance by the data sheet."""
        drift = self.least**2 * Process(self.time_s).correlation(t_s)
        return np.asarray(drift + np.diag(sigma**2))


@dataclass(frozen=True)
class Noise:
    """The errors of one source."""

    white: float = 1.0
    """Factor on the data sheet's noise."""
    size: float = 0.0
    """1 sigma of the process on top, in the residual's unit."""
    process: Process = Process(1.0)

    def covariance(
        self,
        t_s: Array,  # [N] s
        sigma: Array,  # [N] white, in the residual's unit
        part: SlowPart,
    ) -> Array:
        """[N, N] of one component of the residuals."""
        base = self.white**2 * part.base(t_s, sigma)
        return base + self.size**2 * self.process.correlation(t_s)


def likeliest(
    t_s: Array,  # [N] s
    r: Array,  # [N, D] residuals, D components of equal noise
    sigma: Array,  # [N]
    part: SlowPart,
) -> Noise:
    """The noise under which the residuals are likeliest."""
    best, found = -np.inf, Noise()
    base = part.base(t_s, sigma)
    root = cholesky(base, lower=True)
    unit = float(np.sqrt(np.trace(base) / max(len(base), 1)))
    white_r = solve_triangular(root, r, lower=True)
    for process in part.processes:
        half = solve_triangular(root, process.correlation(t_s), lower=True)
        values, vectors = np.linalg.eigh(solve_triangular(root, half.T, lower=True))
        power = ((vectors.T @ white_r) ** 2).sum(axis=1)
        sizes = (unit * SIZES) ** 2
        variance = WHITE[:, None, None] ** 2 + sizes[None, :, None] * np.maximum(values, 0.0)
        fit = -0.5 * (r.shape[1] * np.log(variance) + power / variance).sum(axis=2)
        i, j = np.unravel_index(int(np.argmax(fit)), fit.shape)
        if fit[i, j] > best:
            best = float(fit[i, j])
            found = Noise(float(WHITE[i]), unit * float(SIZES[j]), process)
    return found
