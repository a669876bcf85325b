"""Robust statistics: kernels that bound what an outlier can do, and spreads that it cannot widen.

A kernel replaces half the square s^2 / 2 of a residual's size s (in standard deviations) by a cost
rho(s) that grows more slowly. Iteratively reweighted least squares minimises the sum of the costs
with weights w(s) = rho'(s) / s on the squares: the gradient is the cost's own, and the Hessian is
positive (Z. Zhang, Image and Vision Computing 15 (1997), "Parameter estimation techniques").
Every kernel here has rho(s) -> s^2 / 2 and w(s) -> 1 for small s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MAD_TO_SIGMA = 1.4826
"""Standard deviation over the median absolute deviation, of a normal distribution."""
MEDIAN_LENGTH = 1.1774
"""Median length of a normal error in two dimensions, sqrt(2 ln 2), in sigmas of each component."""
HUBER_95 = 1.345
"""Sigmas where Huber's cost turns linear: 95 % efficient where the noise is Gaussian."""
HUBER_LENGTH = 2.0
"""The same for lengths in two dimensions: nine in ten normal errors are shorter."""
TUKEY_95 = 4.685
"""Sigmas beyond which Tukey's biweight counts nothing: 95 % efficient under Gaussian noise."""


class RobustKernel(Protocol):
    """A robust cost of a residual's size, sigmas, and its weight on the square."""

    def cost(
        self,
        size: Array,  # [...]
    ) -> Array:
        """[...] rho(s) of sizes [...] >= 0."""

    def weight(
        self,
        size: Array,  # [...]
    ) -> Array:
        """[...] rho'(s) / s in [0, 1]."""


@dataclass(frozen=True)
class Huber:
    """s^2 / 2 up to ``bound``, its tangent from there on: convex, so that there is one minimum."""

    bound: float = HUBER_95

    def cost(
        self,
        size: Array,  # [...]
    ) -> Array:
        """[...] rho(s) of sizes [...] >= 0."""
        near = np.minimum(size, self.bound)
        return np.asarray((size - 0.5 * near) * near)

    def weight(
        self,
        size: Array,  # [...]
    ) -> Array:
        """[...] in (0, 1]."""
        return np.asarray(self.bound / np.maximum(size, self.bound))


@dataclass(frozen=True)
class Cauchy:
    """c^2 / 2 log(1 + s^2 / c^2); at c = ``bound`` the weight is a half, it falls by 1 / s^2."""

    bound: float

    def cost(
        self,
        size: Array,  # [...]
    ) -> Array:
        """[...] rho(s) of sizes [...] >= 0."""
        return np.asarray(0.5 * self.bound**2 * np.log1p((size / self.bound) ** 2))

    def weight(
        self,
        size: Array,  # [...]
    ) -> Array:
        """[...] in (0, 1]."""
        return np.asarray(1.0 / (1.0 + (size / self.bound) ** 2))


@dataclass(frozen=True)
class SoftL1:
    """sqrt(1 + s^2) - 1: a smooth Huber, with no bound to choose."""

    def cost(
        self,
        size: Array,  # [...]
    ) -> Array:
        """[...] rho(s) of sizes [...] >= 0."""
        return np.asarray(np.sqrt(1.0 + size**2) - 1.0)

    def weight(
        self,
        size: Array,  # [...]
    ) -> Array:
        """[...] in (0, 1]."""
        return np.asarray(1.0 / np.sqrt(1.0 + size**2))


@dataclass(frozen=True)
class Tukey:
    """c^2 / 6 (1 - (1 - s^2 / c^2)^3), constant from c = ``bound`` on: what is farther off counts
    nothing. Not convex: a descent needs a start among the inliers."""

    bound: float = TUKEY_95

    def cost(
        self,
        size: Array,  # [...]
    ) -> Array:
        """[...] rho(s) of sizes [...] >= 0."""
        inside = np.clip(1.0 - (size / self.bound) ** 2, 0.0, None)
        return np.asarray(self.bound**2 / 6.0 * (1.0 - inside**3))

    def weight(
        self,
        size: Array,  # [...]
    ) -> Array:
        """[...] in [0, 1]: 0 from ``bound`` on."""
        return np.asarray(np.clip(1.0 - (size / self.bound) ** 2, 0.0, None) ** 2)


def sigma_of(residuals: npt.ArrayLike) -> float:
    """Standard deviation of normal residuals about 0, from the median of their sizes: up to half of
    them may be outliers. 0 for none."""
    size = np.abs(np.asarray(residuals, dtype=np.float64))
    return MAD_TO_SIGMA * float(np.median(size)) if size.size else 0.0


def sigma_of_lengths(
    size: Array,  # [M] lengths in two dimensions
) -> float:
    """Standard deviation of each component of normal errors, by their median length; 0 for none."""
    return float(np.median(size)) / MEDIAN_LENGTH if len(size) else 0.0
