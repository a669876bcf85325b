"""Keypoints of two pictures that show the same thing."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.prior.contract import Float, Keypoints

Index = npt.NDArray[np.int64]

LOWE_RATIO = 0.8
"""Distance to the nearest over distance to the second: above, the match is not clear (Lowe)."""


def take_root(
    descriptors: Float,  # [M, d]
) -> Float:
    """[M, d] of unit length: signed square roots after L1 normalisation (RootSIFT).

    No few large entries decide how near two descriptors are.
    """
    size = np.maximum(np.abs(descriptors).sum(1, keepdims=True), 1e-12)
    share = descriptors / size
    return np.asarray(np.sign(share) * np.sqrt(np.abs(share)), dtype=np.float32)


def match_keypoints(a: Keypoints, b: Keypoints) -> tuple[Index, Index]:
    """Indices [M] into a and into b of keypoints that are each other's nearest, and clearly so."""
    if len(a.pixels) == 0 or len(b.pixels) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    # Of unit length: the nearest is the one with the largest product.
    product = take_root(a.descriptors) @ take_root(b.descriptors).T
    nearest, back = product.argmax(1), product.argmax(0)
    rows = np.arange(len(product))
    best = product[rows, nearest]
    product[rows, nearest] = -np.inf
    # |x - y|^2 = 2 (1 - x . y)
    clear = 1.0 - best < LOWE_RATIO**2 * (1.0 - product.max(1))
    kept = np.nonzero(clear & (back[nearest] == rows))[0]
    return kept, nearest[kept]
