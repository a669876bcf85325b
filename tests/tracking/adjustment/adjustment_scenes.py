"""Keyframes over a known floor: exact poses, depths and matches, and what is done to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3, Sim3Batch, so3_exp
from aquaflow.tracking.adjustment.equations import AnchorMatches, Links
from aquaflow.tracking.adjustment.joint import JointProblem

Array = npt.NDArray[np.float64]

POINTS = 120
NOISE = 0.2 / 400.0
"""Normalised plane: a fifth of a pixel."""
HALF = (0.6, 0.45)
"""Half a picture."""


@dataclass
class Scene:
    """True poses and depths, and the matches between neighbours up to ``reach`` apart."""

    poses: list[Sim3]
    rho: list[Array]
    matches: list[AnchorMatches]

    def problem(self, poses: list[Sim3], relative_sigma: float = 0.01) -> JointProblem:
        """From ``poses``; depths of the pointmaps are true to ``relative_sigma``."""
        rng = np.random.default_rng(1)
        matches = []
        for each, rho in zip(self.matches, self.rho, strict=True):
            known = rho * (1.0 + rng.normal(0.0, relative_sigma, len(rho)))
            variance = (relative_sigma * rho) ** 2
            matches.append(
                AnchorMatches(
                    each.anchor, each.views, each.rays, known, variance, each.at, each.used,
                    each.sigma,
                )
            )  # fmt: skip
        held = [np.arange(len(rho)) % 5 == 4 for rho in self.rho]
        free = np.ones(len(poses), dtype=bool)
        free[0] = False
        return JointProblem(matches, held, no_links(), Sim3Batch.of(poses), free)


def no_links() -> Links:
    """Tracking measured nothing."""
    none = np.zeros(0, dtype=np.intp)
    nothing = Sim3Batch.of([Sim3.identity()])[:0]
    return Links(none, none, nothing, np.zeros((0, 7, 7)))


def scene(
    count: int = 5,
    reach: int = 3,
    step: float = 0.15,
    noise: float = NOISE,
    outliers: float = 0.0,
    seed: int = 0,
) -> Scene:
    """A swim along x over relief one unit below, looking down; keyframes of several units."""
    rng = np.random.default_rng(seed)
    scales = 1.0 + 0.1 * np.sin(np.arange(count))
    poses = [
        Sim3(so3_exp(rng.normal(0.0, 0.05, 3)), np.array([step * i, 0.02 * (i % 2), 0.0]), s)
        for i, s in enumerate(scales)
    ]
    depths, matches = [], []
    for i, T in enumerate(poses):
        plane = rng.uniform(-1.0, 1.0, (POINTS, 2)) * HALF
        rays = np.concatenate([plane, np.ones((POINTS, 1))], axis=1)
        rho = T.scale / rng.uniform(0.7, 1.3, POINTS)
        views = [j for j in range(count) if 0 < abs(j - i) <= reach]
        at = np.zeros((len(views), POINTS, 2))
        for v, j in enumerate(views):
            seen = (poses[j].inverse() @ T).apply(rays / rho[:, None])
            at[v] = seen[:, :2] / seen[:, 2:] + rng.normal(0.0, noise, (POINTS, 2))
        wrong = rng.random(at.shape[:2]) < outliers
        at[wrong] += rng.normal(0.0, 0.05, (int(wrong.sum()), 2))
        used = np.asarray((np.abs(at) < HALF).all(axis=-1))
        depths.append(rho)
        matches.append(
            AnchorMatches(
                i, np.array(views, dtype=np.intp), rays, rho, np.ones(POINTS), at, used,
                np.full(len(views), max(noise, 1e-5)),
            )
        )  # fmt: skip
    return Scene(poses, depths, matches)


def shaken(poses: list[Sim3], sigma: float, seed: int = 3) -> list[Sim3]:
    """All but the first moved, turned and scaled by ``sigma``."""
    rng = np.random.default_rng(seed)
    return [poses[0]] + [T @ Sim3.exp(rng.normal(0.0, sigma, 7)) for T in poses[1:]]


def apart(found: Sim3Batch, true: list[Sim3]) -> Array:
    """[K] the largest entry of the motion between found and true poses."""
    return np.asarray(np.abs((found.inverse() @ Sim3Batch.of(true)).log()).max(axis=1))
