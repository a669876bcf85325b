"""Keyframe graphs with known answers: noise of the sigmas that the edges state."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from aquaflow.config import GraphConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph

Array = npt.NDArray[np.float64]

STEP_M = 0.5
SIGMA = np.array([0.01] * 3 + [0.002] * 4)
"""Of sequential edges: m, rad, log-scale."""
LOOP_SIGMA = 2.0 * SIGMA

INFORMATION = np.diag(SIGMA**-2)
EXACT = GraphConfig(tolerance_sigmas=1e-6)


def moved(T: Sim3, x: float = 0.0) -> Sim3:
    return T @ Sim3.exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))


def largest_gap(one: Sim3Batch, other: Sim3Batch) -> float:
    return float(np.abs((one.inverse() @ other).log()).max())


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
        ahead = np.arange(1, self.count)
        links = self.truth[ahead - 1].inverse() @ self.truth[ahead] @ self.errors(self.count - 1)
        T_wc = Sim3Batch.of([Sim3.identity()])
        self.graph.add_keyframe(0, T_wc.element(0))
        for number in range(1, self.count):
            T_wc = T_wc @ links[number - 1 : number]
            self.graph.add_keyframe(number, T_wc.element(0))
            T = links.element(number - 1)
            assert self.graph.add_edge(Edge(number - 1, number, T, np.diag(SIGMA**-2)))

    def errors(self, count: int) -> Sim3Batch:
        """What sequential edges are wrong by."""
        error = SIGMA * self.noise * self.rng.normal(size=(count, 7))
        return Sim3Batch.exp(error + self.bias * SIGMA * np.array([0, 0, 0, 0, 0, 1, 1]))

    def loop(self, a: int, b: int) -> Sim3:
        """A true T_ab with the noise of a loop edge."""
        error = LOOP_SIGMA * self.noise * self.rng.normal(size=7)
        return self.truth.element(a).inverse() @ self.truth.element(b) @ Sim3.exp(error)

    def close(self, *pairs: tuple[int, int]) -> None:
        """True loop edges."""
        for a, b in pairs:
            claim = Edge(a, b, self.loop(a, b), np.diag(LOOP_SIGMA**-2), loop=True)
            assert self.graph.add_edge(claim)

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
