"""Keyframe graphs with known answers: noise of the sigmas that the edges state."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from aquaflow.config import GraphConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.similarity_batch import Sim3Batch
from aquaflow.tracking.pose_graph import Edge, PoseGraph

Array = npt.NDArray[np.float64]

STEP_M = 0.5
SIGMA = np.array([0.01] * 3 + [0.002] * 4)
"""Of sequential edges: m, rad, log-scale."""
LOOP_SIGMA = 2.0 * SIGMA


def circle(count: int) -> Sim3Batch:
    """Keyframes that look along a circle, the last beside the first."""
    angle = 2 * np.pi * np.arange(count) / count
    radius = STEP_M * count / (2 * np.pi)
    zero = np.zeros(count)
    centre = np.stack([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), zero], axis=1)
    turn = Sim3Batch.exp(np.stack([zero, zero, zero, zero, zero, angle, zero], axis=1))
    return Sim3Batch(turn.R, centre, np.ones(count))


@dataclass
class Dive:
    """A graph whose sequential edges have drifted, and the truth."""

    count: int
    seed: int = 0
    bias: float = 0.0
    """Systematic error of every edge in yaw and scale, in sigmas."""
    noise: float = 1.0
    config: GraphConfig = field(default_factory=GraphConfig)

    def __post_init__(self) -> None:
        self.truth = circle(self.count)
        self.rng = np.random.default_rng(self.seed)
        self.graph = PoseGraph(self.config)
        self.graph.add_keyframe(0, Sim3.identity())
        for number in range(1, self.count):
            self.extend(number)

    def measured(self, a: int, b: int, sigma: Array, bias: float = 0.0) -> Sim3:
        """T_ab with noise."""
        error = sigma * self.noise * self.rng.normal(size=7)
        error += bias * sigma * np.array([0, 0, 0, 0, 0, 1, 1])
        return self.truth.element(a).inverse() @ self.truth.element(b) @ Sim3.exp(error)

    def extend(self, number: int) -> None:
        """The next keyframe where tracking saw it, and its sequential edge."""
        T = self.measured(number - 1, number, SIGMA, self.bias)
        self.graph.add_keyframe(number, self.graph.pose(number - 1) @ T)
        assert self.graph.add_edge(Edge(number - 1, number, T, np.diag(SIGMA**-2)))

    def close(self, *pairs: tuple[int, int]) -> None:
        """True loop edges."""
        for a, b in pairs:
            T = self.measured(a, b, LOOP_SIGMA)
            assert self.graph.add_edge(Edge(a, b, T, np.diag(LOOP_SIGMA**-2), loop=True))

    def plant(self, *pairs: tuple[int, int]) -> None:
        """False loop edges: two places said to be nearly the same."""
        for a, b in pairs:
            T = Sim3.exp(self.rng.normal(size=7) * np.array([0.5] * 3 + [0.2] * 3 + [0.05]))
            assert self.graph.add_edge(Edge(a, b, T, np.diag(LOOP_SIGMA**-2), loop=True))

    def poses(self) -> Sim3Batch:
        return Sim3Batch.of([self.graph.pose(number) for number in range(self.count)])

    def ate_m(self) -> float:
        """Root mean square position error after alignment by a similarity."""
        found = self.poses().t
        aligned = align(found, self.truth.t, with_scale=True).T_target_source.apply(found)
        return float(np.sqrt(((aligned - self.truth.t) ** 2).sum(axis=1).mean()))

    def seam_m(self) -> float:
        """Error of the last keyframe's place as seen from the first."""
        found = self.graph.pose(0).inverse() @ self.graph.pose(self.count - 1)
        true = self.truth.element(0).inverse() @ self.truth.element(self.count - 1)
        return float(np.linalg.norm(found.t - true.t))
