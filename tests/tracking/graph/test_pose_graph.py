"""The keyframe graph: known answers, invariance, bad input, information."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.tracking.graph.equations import Equations, Misfit
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph, edge_information, solve
from tests.tracking.graph.graph_scenes import (
    EXACT,
    INFORMATION,
    LOOP_SIGMA,
    Dive,
    largest_gap,
    moved,
)

Array = npt.NDArray[np.float64]


def test_gradient_and_hessian_are_the_derivatives_of_the_cost() -> None:
    rng = np.random.default_rng(0)
    dive = Dive(5, noise=20.0)
    dive.close((0, 4), (1, 3))
    edges = dive.graph.snapshot().edges.copy()
    edges["loop"] = False
    for edge in edges:
        A = rng.normal(size=(7, 7))
        edge["information"] = A @ A.T
    poses, allowed = dive.poses(), np.full(len(edges), 1e9)
    at = Equations(Misfit(poses, edges, allowed, huber=1e9), 0.0)

    def residuals(d: Array) -> Array:
        return Misfit(poses @ Sim3Batch.exp(d.reshape(5, 7)), edges, allowed, huber=1e9).r

    step = 1e-6
    J = np.stack(
        [(residuals(step * e) - residuals(-step * e)) / (2 * step) for e in np.eye(35)],
        axis=-1,
    )
    pull = edges["information"] @ at.misfit.r[:, :, None]
    gradient = (J.transpose(0, 2, 1) @ pull).sum(axis=0).ravel()
    H = (J.transpose(0, 2, 1) @ edges["information"] @ J).sum(axis=0)
    np.testing.assert_allclose(at.gradient.ravel(), gradient, rtol=1e-6, atol=1e-6)
    for i in range(5):
        block = slice(7 * i, 7 * i + 7)
        np.testing.assert_allclose(at.diagonal[i], H[block, block], rtol=1e-6, atol=1e-6)
    a, b = 7 * edges["a"][4], 7 * edges["b"][4]
    np.testing.assert_allclose(at.H_ab[4], H[a : a + 7, b : b + 7], rtol=1e-6, atol=1e-6)


def test_without_noise_nothing_moves() -> None:
    dive = Dive(30, noise=0.0)
    dive.close((0, 29))
    result = dive.graph.optimise(everything=True)
    assert result.cost_before < 1e-12
    assert largest_gap(dive.poses(), dive.truth) < 1e-9


def test_a_closed_circle_loses_its_drift_at_the_seam() -> None:
    dive = Dive(100, seed=1)
    seam, ate = dive.seam_m(), dive.ate_m()
    dive.close((0, 99))
    result = dive.graph.optimise()
    assert dive.seam_m() < seam / 5
    assert dive.ate_m() < ate / 2
    assert result.cost_after < result.cost_before
    assert list(result.trust.values()) == [1.0]


def test_scale_that_drifts_over_a_hundred_keyframes_is_recovered() -> None:
    dive = Dive(100, seed=2, bias=1.0)
    drift = abs(np.log(dive.graph.pose(99).scale))
    dive.close((0, 99), (1, 98), (2, 97))
    dive.graph.optimise()
    assert drift > 0.1
    assert np.abs(np.log(dive.poses().scale)).max() < 0.01


def test_the_first_keyframe_keeps_its_pose_and_scale() -> None:
    dive = Dive(50)
    dive.close((0, 49), (5, 45))
    result = dive.graph.optimise(everything=True)
    assert 0 not in result.poses
    np.testing.assert_array_equal(dive.graph.pose(0).matrix, np.eye(4))


@settings(max_examples=15, deadline=None)
@given(
    st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3),
    st.lists(st.floats(-1.5, 1.5), min_size=4, max_size=4),
)
def test_another_world_gives_the_same_map_in_it(shift: list[float], turn: list[float]) -> None:
    here, there = PoseGraph(), PoseGraph()
    dive = Dive(20, seed=3)
    dive.close((0, 19))
    S = Sim3.exp(np.array([*shift, *turn]))
    edges = dive.graph.snapshot().edges
    for number in range(20):
        here.add_keyframe(number, dive.graph.pose(number))
        there.add_keyframe(number, S @ dive.graph.pose(number))
    for edge in edges:
        T = Sim3(edge["R"].copy(), edge["t"].copy(), float(edge["scale"]))
        for graph in (here, there):
            # Edges into a keyframe of its own component would first put it where they say.
            graph.add_edge(Edge(int(edge["a"]), int(edge["b"]), T, edge["information"], True))
    here.optimise(everything=True)
    there.optimise(everything=True)
    for number in range(20):
        gap = (S @ here.pose(number)).inverse() @ there.pose(number)
        assert np.abs(gap.log()).max() < 1e-5


def test_the_order_of_an_edge_does_not_matter() -> None:
    poses = []
    for flip in (False, True):
        dive = Dive(40, seed=4, config=EXACT)
        T = dive.loop(0, 39)
        information = np.diag(LOOP_SIGMA**-2)
        if flip:
            # The same error seen from the other end.
            Ad = Sim3Batch.of([T.inverse()]).adjoint()[0]
            dive.graph.add_edge(Edge(39, 0, T.inverse(), Ad.T @ information @ Ad, True))
        else:
            dive.graph.add_edge(Edge(0, 39, T, information, True))
        dive.graph.optimise()
        poses.append(dive.poses())
    assert largest_gap(*poses) < 1e-4


def test_two_runs_give_the_same_bits() -> None:
    poses = []
    for _ in range(2):
        dive = Dive(60, seed=5, bias=0.5)
        dive.close((0, 59), (1, 58))
        dive.plant((10, 40))
        dive.graph.optimise()
        poses.append(dive.poses())
    np.testing.assert_array_equal(poses[0].t, poses[1].t)
    np.testing.assert_array_equal(poses[0].R, poses[1].R)


# Bad input


@pytest.mark.parametrize(
    ("a", "b", "T", "information", "reason"),
    [
        (1, 1, Sim3.identity(), INFORMATION, "edge needs two different known keyframes"),
        (1, 99, Sim3.identity(), INFORMATION, "edge needs two different known keyframes"),
        (0, 2, Sim3(np.eye(3), np.full(3, np.nan)), INFORMATION, "edge pose is not finite"),
        (0, 2, Sim3(np.eye(3), np.zeros(3), 0.0), INFORMATION, "edge pose is not finite"),
        (0, 2, Sim3.identity(), np.full((7, 7), np.inf), "edge information is not finite"),
        (0, 2, Sim3.identity(), np.eye(6), "edge information is not finite"),
        (0, 2, Sim3.identity(), np.zeros((7, 7)), "edge information is empty"),
        (0, 2, Sim3.identity(), -INFORMATION, "edge information is empty"),
    ],
)
def test_a_bad_edge_is_refused_and_counted(
    a: int, b: int, T: Sim3, information: Array, reason: str
) -> None:
    dive = Dive(5)
    assert not dive.graph.add_edge(Edge(a, b, T, information))
    assert dive.graph.refused == {reason: 1}
    assert len(dive.graph.snapshot().edges) == 4


def test_a_bad_keyframe_is_refused_and_counted() -> None:
    graph = PoseGraph()
    assert graph.add_keyframe(0, Sim3.identity())
    assert not graph.add_keyframe(0, Sim3.identity())
    assert not graph.add_keyframe(1, Sim3(np.eye(3), np.full(3, np.inf)))
    assert sum(graph.refused.values()) == 2
    assert graph.optimise().poses == {}


def test_information_is_made_symmetric_and_positive() -> None:
    dive = Dive(3)
    bad = INFORMATION.copy()
    bad[0, 0] = -1e4
    bad[1, 2] += 10.0
    assert dive.graph.add_edge(Edge(0, 2, dive.graph.pose(2), bad))
    kept = dive.graph.snapshot().edges["information"][-1]
    np.testing.assert_array_equal(kept, kept.T)
    assert np.linalg.eigvalsh(kept).min() > -1e-6


def test_directions_that_no_edge_knows_stay_as_they_are() -> None:
    dive = Dive(10)
    no_scale = np.diag(np.append(LOOP_SIGMA[:6] ** -2, 0.0))
    graph = PoseGraph()
    for number in range(10):
        graph.add_keyframe(number, dive.graph.pose(number))
    for number in range(9):
        T = graph.pose(number).inverse() @ graph.pose(number + 1)
        graph.add_edge(Edge(number, number + 1, moved(T, 0.01), no_scale))
    graph.add_edge(Edge(0, 9, graph.pose(9), no_scale))
    graph.optimise(everything=True)
    found = Sim3Batch.of([graph.pose(number) for number in range(10)])
    assert np.isfinite(found.t).all()
    assert np.abs(np.log(found.scale)).max() < 0.2


def test_an_absurd_edge_leaves_numbers_finite() -> None:
    dive = Dive(20)
    T = Sim3.exp(np.array([1e6, 0, 0, 0, 0, 3.1, 5.0]))
    dive.graph.add_edge(Edge(0, 19, T, 1e30 * np.eye(7)))
    dive.graph.optimise()
    assert np.isfinite(dive.poses().t).all()
    assert np.isfinite(dive.poses().scale).all()


# Information


def test_edge_information_is_that_of_the_samples_it_stands_for() -> None:
    rng = np.random.default_rng(0)
    A = 1e-3 * rng.normal(size=(6, 6))
    covariance, scale_sigma = A @ A.T + 1e-6 * np.eye(6), 2e-3
    T_ab = Sim3.exp(np.array([2.0, -1.0, 3.0, 0.3, 0.5, -0.2, 0.4]))
    noise = rng.multivariate_normal(np.zeros(6), covariance, 20_000)
    left = Sim3Batch.exp(np.concatenate([noise, np.zeros((20_000, 1))], axis=1))
    scales = np.zeros((20_000, 7))
    scales[:, 6] = scale_sigma * rng.normal(size=20_000)
    T = Sim3Batch.of([T_ab])
    samples = left @ Sim3Batch(*(np.repeat(x, 20_000, axis=0) for x in (T.R, T.t, T.scale)))
    errors = (T.inverse() @ (samples @ Sim3Batch.exp(scales))).log()
    found = np.linalg.inv(edge_information(covariance, scale_sigma, T_ab))
    sigma = np.sqrt(np.diag(found))
    expected = np.cov(errors.T)
    np.testing.assert_allclose(
        found / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=0.05
    )


def test_a_result_that_is_not_finite_is_not_taken_over() -> None:
    dive = Dive(12, bias=1.0)
    dive.close((0, 11))
    before = dive.poses()
    result = solve(dive.graph.snapshot())
    result.solved["t"][0] = np.nan
    with pytest.raises(ArithmeticError):
        dive.graph.apply(result)
    np.testing.assert_array_equal(dive.poses().t, before.t)
