"""Which of many core points changed, with a bound on how many of them did not.

Where nothing changed, a distance over its sigma should have a spread of 1. Errors that no sigma
states (a map's own bends, shade) make it wider. Most of a site is as it was, so that the spread of
all points is that of the unchanged ones: sigmas are multiplied by it, never by less than 1 (an
empirical null: B. Efron, "Large-Scale Simultaneous Hypothesis Testing", JASA 99 (2004)).

The share of false ones among the points that are called changed is then held below a rate by
Y. Benjamini, Y. Hochberg, "Controlling the False Discovery Rate", J. R. Stat. Soc. B 57 (1995),
which allows for neighbours that err alike (Benjamini and Yekutieli, 2001). Where nothing changed at
all, every find is false, so that the rate is the probability of finding anything.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student

from aquaflow.optimise.robust import sigma_of

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

LEAST_SPREAD = 1e-3
"""Of measured scores: the same dive twice has none."""


def null_spread(
    scores: Array,  # [N] over their sigmas; NaN: none
) -> tuple[float, float]:
    """Middle and spread of the unchanged: the median, and what sigmas have to be multiplied by."""
    known = scores[np.isfinite(scores)]
    if len(known) == 0:
        return 0.0, 1.0
    middle = float(np.median(known))
    spread = sigma_of(known - middle)
    return middle, max(1.0, spread)


def measured_spread(
    scores: Array,  # [N] over their sigmas, about 0; NaN: none
) -> float:
    """Spread of the unchanged, less than 1 too: what sigmas that all places share do not add to."""
    known = np.abs(scores[np.isfinite(scores)])
    spread = sigma_of(known) if len(known) else 1.0
    return max(LEAST_SPREAD, spread)


def two_sided(
    scores: Array,  # [N] of a null with spread 1; NaN: none
    freedom: Array,  # [N] degrees of freedom
) -> Array:
    """[N] probabilities of a score as far from 0; NaN where there is none."""
    return np.asarray(2.0 * student.sf(np.abs(scores), freedom))


def discoveries(
    probabilities: Array,  # [N] NaN: none
    rate: float,
) -> Flags:
    """[N] True where something is found; of those the share ``rate`` at most is expected false."""
    found = np.zeros(len(probabilities), bool)
    tested = np.flatnonzero(np.isfinite(probabilities))
    if len(tested) == 0:
        return found
    ordered = tested[np.argsort(probabilities[tested], kind="stable")]
    allowed = rate * np.arange(1, len(ordered) + 1) / len(ordered)
    below = np.flatnonzero(probabilities[ordered] <= allowed)
    if len(below):
        found[ordered[: below[-1] + 1]] = True
    return found
