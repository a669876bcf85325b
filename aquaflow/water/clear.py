"""Clear water, or air: its odds against water that dims and veils what is far.

Contrast is never quite the same from near and from far, as ranges and poses are not exact; scenes
without water look like one of a hundredth of an optical depth, in all colours alike. A fit that
finds no more than this found clear water.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.water.parameters import RATE_ROWS, rate_rows
from aquaflow.water.solver import WaterFit

Array = npt.NDArray[np.float64]

OPTICAL_DEPTH, OPTICAL_DEPTH_SIGMA = 0.02, 1.0
"""At the median range, and its sigma in the log. Found on rendered dives without water (reef, flat
sand, pipe): 0.01 to 0.05."""
RATIO_SIGMA = 0.15
"""Log of red over green and of blue over green: 0.02 to 0.1 on the same dives."""
CONTRAST_SIGMA = 0.03
"""Optical depth, at the median range, by which a scene's contrast changes without water, alike in
RGB: of 50 rendered dives in water most change by less than 0.01, some by 0.05."""
ROWS = rate_rows(OPTICAL_DEPTH_SIGMA, RATIO_SIGMA, RATIO_SIGMA)
"""Whitens log beta_a of clear water."""
LEAST_DEPTH = 1e-6
"""Guards the division by the optical depth of water that is not there."""
LEAST_INFORMATION = 1e-6
"""Guards the inverse where the observations say nothing of a direction."""


def log_odds_clear(
    fit: WaterFit,  # with water
) -> float:
    """Of clear water against the water of the fit's prior: what the observations say of log beta_a
    under the prior of the one and of the other, all as normal distributions."""
    found, start = fit.x[:3], fit.problem.start[:3]
    wet = RATE_ROWS.T @ RATE_ROWS
    posterior = np.linalg.inv(attenuation_covariance(fit))
    values, vectors = np.linalg.eigh(posterior - wet)
    seen = (vectors * np.maximum(values, LEAST_INFORMATION)) @ vectors.T
    middle = np.linalg.solve(seen, posterior @ found - wet @ start)
    clear = np.full(3, np.log(OPTICAL_DEPTH / fit.problem.median_range))
    spread = np.linalg.inv(seen)
    dry, water = np.linalg.inv(ROWS.T @ ROWS), np.linalg.inv(wet)
    return _log_normal(middle - clear, spread + dry) - _log_normal(middle - start, spread + water)


def attenuation_covariance(
    fit: WaterFit,  # with water
) -> Array:
    """[3, 3] of log beta_a: by the observations' errors, and by CONTRAST_SIGMA."""
    depth = np.maximum(np.exp(fit.x[:3]) * fit.problem.median_range, LEAST_DEPTH)
    alike = CONTRAST_SIGMA / depth
    return np.asarray(fit.repeated_covariance[:3, :3] + np.outer(alike, alike))


def _log_normal(
    off: Array,  # [K]
    covariance: Array,  # [K, K]
) -> float:
    """Log density up to the constant that all normal distributions in K dimensions share."""
    return float(-0.5 * (off @ np.linalg.solve(covariance, off) + np.linalg.slogdet(covariance)[1]))
