"""Gaussians as a browser gets them: those that matter most, as covariances and colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Splats:
    """N Gaussians, in the world."""

    centres: Float
    """[N, 3]"""
    covariances: Float
    """[N, 3, 3]"""
    opacities: Float
    """[N]"""
    colours: dict[str, Float]
    """[N, 3] in [0, 1] by what they show: water, clear, coverage."""

    def __len__(self) -> int:
        return len(self.centres)


def splats(
    means: Float,  # [N, 3]
    quats: Float,  # [N, 4] wxyz, of any length
    scales: Float,  # [N, 3]
    opacities: Float,  # [N]
    colours: dict[str, Float],  # [N, 3] each
    budget: int,
) -> Splats:
    """At most ``budget`` of them: those that cover most, by opacity and area. The others' share of
    the surface goes to them, so that no holes open.

    What is not finite is left out.
    """
    sound = np.isfinite(means).all(1) & np.isfinite(scales).all(1) & np.isfinite(quats).all(1)
    sound &= np.isfinite(opacities)
    for values in colours.values():
        sound &= np.isfinite(values).all(1)
    largest = np.sort(np.where(sound[:, None], scales, 0.0), axis=1)[:, 1:]
    weight = np.where(sound, opacities * largest.prod(axis=1), 0.0)
    chosen = np.flatnonzero(sound)
    grown = 1.0
    if len(chosen) > budget:
        order = np.argpartition(-weight, budget)[:budget]
        chosen = np.sort(order)
        # Areas grow by the root of what was left out: twice the gaps, no mud.
        share = float(weight[chosen].sum() / max(float(weight.sum()), 1e-12))
        grown = min(max(share, 0.25), 1.0) ** -0.25
    return Splats(
        means[chosen].astype(np.float32),
        covariances(quats[chosen], grown * scales[chosen]),
        np.clip(opacities[chosen], 0.0, 1.0).astype(np.float32),
        {name: np.clip(c[chosen], 0.0, 1.0).astype(np.float32) for name, c in colours.items()},
    )


def covariances(
    quats: Float,  # [N, 4] wxyz, of any length
    scales: Float,  # [N, 3]
) -> Float:
    """[N, 3, 3] R S S^T R^T."""
    length = np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
    w, x, y, z = (quats / length).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    R = np.moveaxis(np.array(rows), -1, 0)
    M = R * scales[:, None, :]
    return np.asarray(M @ M.transpose(0, 2, 1), dtype=np.float32)


def heat(
    values: npt.NDArray[np.floating],  # [N] in [0, 1]
) -> Float:
    """[N, 3] from violet (0) over green to yellow (1): viridis by three of its colours."""
    stops = np.array([[0.27, 0.00, 0.33], [0.13, 0.57, 0.55], [0.99, 0.91, 0.14]])
    at = np.clip(np.nan_to_num(values), 0.0, 1.0)
    channels = [np.interp(at, (0.0, 0.5, 1.0), stops[:, c]) for c in range(3)]
    return np.stack(channels, axis=1).astype(np.float32)
