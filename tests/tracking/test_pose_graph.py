"""The keyframe graph: known answers, invariance, components, increments, threads, bad input."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from graph_scenes import LOOP_SIGMA, SIGMA, Dive
from hypothesis import given, settings
from hypothesis import strategies as st

from aquaflow.config import GraphConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.similarity_batch import Sim3Batch
from aquaflow.tracking.pose_graph import Edge, PoseGraph, edge_information, solve
from aquaflow.tracking.pose_graph_equations import Equations, Misfit, poses_of

Array = npt.NDArray[np.float64]
EXACT = GraphConfig(tolerance_sigmas=1e-6)
INFORMATION = np.diag(SIGMA**-2)


def moved(T: Sim3, x: float = 0.0) -> Sim3:
    return T @ Sim3.exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))


def largest_gap(one: Sim3Batch, other: Sim3Batch) -> float:
    return float(np.abs((one.inverse() @ other).log()).max())


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
    assert dive.graph.pose(0) == dive.graph.pose(0)
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
        T = dive.measured(0, 39, LOOP_SIGMA)
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


# Components


def two_dives() -> tuple[Dive, Sim3]:
    """Keyframes 0..19 in one world, 20..39 in another; T_wc of 20 as the first world sees it."""
    whole = Dive(40, noise=0.0)
    T_first = whole.graph.pose(20)
    dive = Dive(20, noise=0.0)
    there = Sim3.exp(np.array([5.0, -3.0, 1.0, 0.2, -0.4, 1.0, 0.5]))
    for number in range(20, 40):
        dive.graph.add_keyframe(number, there @ whole.graph.pose(number))
        if number > 20:
            T = whole.graph.pose(number - 1).inverse() @ whole.graph.pose(number)
            dive.graph.add_edge(Edge(number - 1, number, T, INFORMATION))
    return dive, T_first


def test_a_sub_map_is_a_component_until_an_edge_joins_it() -> None:
    dive, T_first = two_dives()
    graph = dive.graph
    assert graph.component_of(19) == 0
    assert graph.component_of(39) == 20
    inner = graph.pose(25).inverse() @ graph.pose(35)
    assert graph.add_edge(
        Edge(30, 10, graph.pose(30).inverse() @ graph.pose(30), INFORMATION, True)
    )
    assert graph.component_of(39) == 0
    result = graph.optimise()
    np.testing.assert_allclose(graph.pose(30).matrix, graph.pose(10).matrix, atol=1e-9)
    assert set(range(20, 40)) <= set(result.poses)
    assert not set(range(20)) & set(result.poses)
    still = graph.pose(25).inverse() @ graph.pose(35)
    np.testing.assert_allclose(still.matrix, inner.matrix, atol=1e-9)
    assert T_first.is_finite()


def test_a_joining_edge_moves_the_later_component_by_the_similarity_it_implies() -> None:
    dive, T_first = two_dives()
    graph = dive.graph
    T = graph.pose(19).inverse() @ T_first
    graph.add_edge(Edge(19, 20, T, INFORMATION, loop=True))
    result = graph.optimise()
    assert result.cost_after < 1e-12
    np.testing.assert_allclose(graph.pose(20).matrix, T_first.matrix, atol=1e-9)
    np.testing.assert_allclose(
        graph.pose(39).matrix, Dive(40, noise=0.0).graph.pose(39).matrix, atol=1e-9
    )
    np.testing.assert_allclose(result.poses[39].matrix, graph.pose(39).matrix)


# Increments


def test_a_keyframe_with_only_a_sequential_edge_changes_nothing() -> None:
    dive = Dive(50)
    dive.graph.optimise()
    dive.count = 51
    dive.truth = Sim3Batch.of([*(dive.truth.element(i) for i in range(50)), moved(Sim3.identity())])
    dive.extend(50)
    result = dive.graph.optimise()
    assert result.iterations == 0
    assert not result.poses


def test_increments_arrive_where_one_full_optimisation_does() -> None:
    steps, whole = Dive(80, seed=6, config=EXACT), Dive(80, seed=6, config=EXACT)
    pairs = [(0, 79), (3, 30), (20, 60), (10, 12), (5, 70)]
    for pair in pairs:
        steps.close(pair)
        steps.graph.optimise()
    whole.close(*pairs)
    whole.graph.optimise(everything=True)
    assert largest_gap(steps.poses(), whole.poses()) < 1e-3 * SIGMA.min()


def test_a_small_correction_moves_only_poses_around_it() -> None:
    dive = Dive(400, seed=7)
    dive.close((0, 399))
    dive.graph.optimise()
    a, b = dive.graph.pose(200), dive.graph.pose(205)
    T = moved(a.inverse() @ b, 0.01)
    dive.graph.add_edge(Edge(200, 205, T, np.diag(LOOP_SIGMA**-2), loop=True))
    result = dive.graph.optimise()
    assert {201, 205} <= set(result.poses)
    assert len(result.poses) < 200


def test_an_edge_that_agrees_with_the_map_costs_no_step() -> None:
    dive = Dive(60)
    T = dive.graph.pose(20).inverse() @ dive.graph.pose(30)
    dive.graph.optimise()
    dive.graph.add_edge(Edge(20, 30, T, np.diag(LOOP_SIGMA**-2), loop=True))
    result = dive.graph.optimise()
    assert result.iterations == 0
    assert list(result.trust.values()) == [1.0]


def test_ten_thousand_keyframes_are_optimised() -> None:
    count = 10_000
    dive = Dive(count, seed=8, noise=0.1)
    seam = dive.seam_m()
    dive.close((0, count - 1), (1, count - 2), (100, 9000), (2000, 2050))
    result = dive.graph.optimise(everything=True)
    assert dive.seam_m() < seam / 5
    assert all(trust == 1.0 for trust in result.trust.values())


# Beside tracking


def test_keyframes_added_while_solving_stay_where_they_were_to_their_predecessor() -> None:
    dive = Dive(60, seed=9)
    dive.close((0, 49))
    graph = dive.graph
    snapshot = graph.snapshot()
    late = moved(graph.pose(59), STEP)
    graph.add_keyframe(60, late)
    graph.add_edge(Edge(59, 60, graph.pose(59).inverse() @ late, INFORMATION))
    graph.add_keyframe(61, moved(late, STEP))
    graph.add_edge(Edge(60, 61, moved(Sim3.identity(), STEP), INFORMATION))
    before = graph.pose(59)
    applied = graph.apply(solve(snapshot))
    assert applied is not None
    assert np.linalg.norm(graph.pose(59).t - before.t) > 0.01
    expected = moved(graph.pose(59), STEP)
    np.testing.assert_allclose(graph.pose(60).matrix, expected.matrix, atol=1e-9)
    np.testing.assert_allclose(graph.pose(61).matrix, moved(expected, STEP).matrix, atol=1e-9)
    assert {60, 61} <= set(applied.poses)
    assert graph.optimise().iterations == 0


STEP = 0.5


def test_a_snapshot_does_not_see_what_comes_later() -> None:
    dive = Dive(30, seed=10)
    dive.close((0, 29))
    snapshot = dive.graph.snapshot()
    alone = solve(snapshot)
    dive.close((3, 20))
    dive.graph.add_keyframe(30, Sim3.identity())
    dive.graph.optimise()
    again = solve(snapshot)
    assert alone.poses.keys() == again.poses.keys()
    assert all(np.array_equal(alone.poses[k].t, again.poses[k].t) for k in alone.poses)
    with pytest.raises(ValueError, match="read-only"):
        snapshot.nodes["scale"][0] = 2.0


def test_a_result_of_an_older_map_is_not_applied() -> None:
    dive = Dive(30, seed=11)
    dive.close((0, 29))
    stale = solve(dive.graph.snapshot())
    dive.graph.optimise()
    poses = dive.poses()
    assert dive.graph.apply(stale) is None
    assert largest_gap(dive.poses(), poses) == 0.0


def test_a_join_while_solving_takes_the_result_along() -> None:
    dive, T_first = two_dives()
    graph = dive.graph
    T = graph.pose(22).inverse() @ graph.pose(38)
    graph.add_edge(Edge(22, 38, moved(T, 0.02), INFORMATION, loop=True))
    result = solve(graph.snapshot())
    assert 38 in result.poses
    graph.add_edge(Edge(19, 20, graph.pose(19).inverse() @ T_first, INFORMATION, loop=True))
    graph.apply(result)
    between = result.poses[30].inverse() @ result.poses[38]
    assert graph.component_of(38) == 0
    np.testing.assert_allclose(graph.pose(20).matrix, T_first.matrix, atol=1e-9)
    np.testing.assert_allclose(
        (graph.pose(30).inverse() @ graph.pose(38)).matrix, between.matrix, atol=1e-9
    )


# Bad input


@pytest.mark.parametrize(
    ("a", "b", "T", "information", "reason"),
    [
        (1, 1, Sim3.identity(), INFORMATION, "edge needs two different known keyframes"),
        (1, 99, Sim3.identity(), INFORMATION, "edge needs two different known keyframes"),
        (0, 2, Sim3(np.eye(3), np.full(3, np.nan)), INFORMATION, "edge pose is not finite"),
        (0, 2, Sim3(np.eye(3), np.zeros(3), 0.0), INFORMATION, "edge pose is not finite"),
        (0, 2, Sim3.identity(), INFORMATION * np.inf, "edge information is not finite"),
        (0, 2, Sim3.identity(), np.eye(6), "edge information is not finite"),
        (0, 2, Sim3.identity(), np.zeros((7, 7)), "edge information is empty"),
        (0, 2, Sim3.identity(), -INFORMATION, "edge information is empty"),
    ],
)
def test_a_bad_edge_is_refused_and_counted(
    a: int, b: int, T: Sim3, information: Array, reason: str
) -> None:
    dive = Dive(5)
    with np.errstate(invalid="ignore"):
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


def test_poses_can_be_read_from_rows() -> None:
    dive = Dive(4)
    np.testing.assert_array_equal(poses_of(dive.graph.snapshot().nodes).t, dive.poses().t)
