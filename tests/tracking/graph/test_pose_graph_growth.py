"""The keyframe graph as it grows: sub-maps that join, increments, and solving beside tracking."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.tracking.graph.pose_graph import Edge, solve
from tests.tracking.graph.graph_scenes import (
    EXACT,
    INFORMATION,
    LOOP_SIGMA,
    SIGMA,
    STEP_M,
    Dive,
    largest_gap,
    moved,
)

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
    graph = two_dives()[0].graph
    assert graph.component_of(19) == 0
    assert graph.component_of(39) == 20
    inner = graph.pose(25).inverse() @ graph.pose(35)
    assert graph.add_edge(Edge(30, 10, Sim3.identity(), INFORMATION, loop=True))
    assert graph.component_of(39) == 0
    result = graph.optimise()
    np.testing.assert_allclose(graph.pose(30).matrix, graph.pose(10).matrix, atol=1e-9)
    assert set(range(20, 40)) <= set(result.poses)
    assert not set(range(20)) & set(result.poses)
    still = graph.pose(25).inverse() @ graph.pose(35)
    np.testing.assert_allclose(still.matrix, inner.matrix, atol=1e-9)


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
    step = moved(Sim3.identity(), STEP_M)
    dive.graph.add_keyframe(50, dive.graph.pose(49) @ step)
    dive.graph.add_edge(Edge(49, 50, step, INFORMATION))
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


@pytest.mark.ci
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
    late = moved(graph.pose(59), STEP_M)
    graph.add_keyframe(60, late)
    graph.add_edge(Edge(59, 60, graph.pose(59).inverse() @ late, INFORMATION))
    graph.add_keyframe(61, moved(late, STEP_M))
    graph.add_edge(Edge(60, 61, moved(Sim3.identity(), STEP_M), INFORMATION))
    before = graph.pose(59)
    applied = graph.apply(solve(snapshot))
    assert applied is not None
    assert np.linalg.norm(graph.pose(59).t - before.t) > 0.01
    expected = moved(graph.pose(59), STEP_M)
    np.testing.assert_allclose(graph.pose(60).matrix, expected.matrix, atol=1e-9)
    np.testing.assert_allclose(graph.pose(61).matrix, moved(expected, STEP_M).matrix, atol=1e-9)
    assert {60, 61} <= set(applied.poses)
    assert graph.optimise().iterations == 0


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
    np.testing.assert_array_equal(dive.poses().t, poses.t)


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


def test_an_edge_to_a_keyframe_in_a_snapshot_leaves_the_snapshot_alone() -> None:
    dive = Dive(5)
    dive.graph.add_keyframe(5, Sim3.identity())
    snapshot = dive.graph.snapshot()
    dive.graph.add_edge(Edge(4, 5, moved(Sim3.identity(), STEP_M), INFORMATION))
    assert snapshot.nodes["component"][5] == 5
    assert not snapshot.nodes["t"][5].any()
    assert dive.graph.component_of(5) == 0
    assert 5 in dive.graph.optimise().poses
