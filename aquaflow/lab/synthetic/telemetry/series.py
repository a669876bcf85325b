"""Random series: errors that wander, and samples that are missing."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

__all__ = ["choose", "random_walk", "stretches", "wander"]

Array: TypeAlias = npt.NDArray[np.float64]
Mask: TypeAlias = npt.NDArray[np.bool_]


def wander(
    t: Array,  # [N] s, equal steps
    sigma: float,
    correlation_s: float,
    axes: int,
    rng: np.random.Generator,
) -> Array:
    """[N, axes] first-order Gauss-Markov processes with correlation exp(-dt / correlation_s)."""
    white = sigma * rng.standard_normal((len(t), axes))
    if len(t) < 2:
        return white
    kept = math.exp(-(t[1] - t[0]) / correlation_s)
    white[1:] *= math.sqrt(1.0 - kept**2)
    return np.asarray(lfilter([1.0], [1.0, -kept], white, axis=0))


def random_walk(
    t: Array,  # [N] s, equal steps
    rate: float,  # sigma gained per square root of a second
    axes: int,
    rng: np.random.Generator,
) -> Array:
    """[N, axes] random walks that begin at 0."""
    steps = rate * rng.standard_normal((len(t), axes))
    steps *= np.sqrt(np.diff(t, prepend=t[:1]))[:, None]
    return np.asarray(np.cumsum(steps, axis=0))


def choose(count: int, share: float, rng: np.random.Generator) -> Mask:
    """[count] True for single samples, a ``share`` of them on average."""
    return np.asarray(rng.uniform(size=count) < share)


def stretches(
    t: Array,  # [N] s
    per_min: float,
    mean_s: float,
    rng: np.random.Generator,
) -> Mask:
    """[N] True within stretches of exponential length that begin ``per_min`` times a minute."""
    inside = np.zeros(len(t), bool)
    if per_min == 0.0 or mean_s == 0.0 or len(t) == 0:
        return inside
    begin = t[0] + rng.exponential(60.0 / per_min)
    while begin <= t[-1]:
        end = begin + rng.exponential(mean_s)
        inside |= (t >= begin) & (t < end)
        begin = end + rng.exponential(60.0 / per_min)
    return inside
