"""Loop edges: true ones close whatever has drifted, false ones do not fold the map."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import GraphConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.tracking.graph.pose_graph import Edge
from tests.tracking.graph.graph_scenes import LOOP_SIGMA, Dive

FALSE = [(5, 40), (12, 70), (30, 62), (8, 55), (41, 88), (20, 83)]
"""Keyframes of a dive of 100 that are metres apart."""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("true", [(), ((0, 99),), ((0, 99), (1, 98), (2, 97))])
@pytest.mark.parametrize("false", [1, 3, 6])
def test_false_loops_change_the_error_by_less_than_a_tenth(
    seed: int, true: tuple[tuple[int, int], ...], false: int
) -> None:
    clean, fouled = Dive(100, seed), Dive(100, seed)
    for dive in (clean, fouled):
        dive.close(*true)
    fouled.plant(*FALSE[:false])
    clean.graph.optimise()
    trust = list(fouled.graph.optimise().trust.values())
    assert abs(fouled.ate_m() - clean.ate_m()) < 0.1 * clean.ate_m()
    assert trust == [1.0] * len(true) + [0.0] * false


def test_without_the_weighing_of_claims_a_false_loop_folds_the_map() -> None:
    credulous = Dive(100, config=GraphConfig(drift_factor=1e6))
    before = credulous.ate_m()
    credulous.plant(FALSE[0])
    credulous.graph.optimise()
    assert credulous.ate_m() > 2 * before


def test_false_loops_one_at_a_time_change_nothing_either() -> None:
    dive = Dive(100, seed=3)
    dive.close((0, 99))
    dive.graph.optimise()
    before = dive.ate_m()
    for pair in FALSE:
        dive.plant(pair)
        dive.graph.optimise()
    assert dive.ate_m() == pytest.approx(before, rel=0.01)


def test_a_lone_true_loop_closes_a_drift_of_half_a_sigma_an_edge() -> None:
    dive = Dive(100, seed=4, bias=0.5)
    seam = dive.seam_m()
    dive.close((0, 99))
    dive.graph.optimise()
    assert seam > 1.0
    assert dive.seam_m() < seam / 5


@pytest.mark.parametrize("bias", [1.0, 2.0])
def test_true_loops_that_agree_close_a_drift_far_beyond_its_covariance(bias: float) -> None:
    dive = Dive(100, seed=5, bias=bias)
    seam, ate = dive.seam_m(), dive.ate_m()
    trusts = []
    for k in range(3):
        dive.close((k, 99 - k))
        trusts.append(list(dive.graph.optimise().trust.values()))
    # One alone is not believed; it is once two others, from other keyframes, say the same.
    assert trusts[0] == [0.0]
    assert trusts[2] == [1.0, 1.0, 1.0]
    assert dive.seam_m() < seam / 5
    assert dive.ate_m() < ate / 5


def test_loops_from_one_keyframe_do_not_corroborate_each_other() -> None:
    dive = Dive(100, seed=5, bias=2.0)
    dive.close((0, 99), (0, 98), (0, 97))
    assert list(dive.graph.optimise().trust.values()) == [0.0, 0.0, 0.0]


def test_a_true_loop_closes_among_false_ones_when_it_has_drifted_far() -> None:
    dive = Dive(100, seed=6, bias=1.5)
    seam = dive.seam_m()
    dive.plant(*FALSE)
    dive.close((0, 99), (1, 98), (2, 97))
    trust = list(dive.graph.optimise().trust.values())
    assert trust == [0.0] * 6 + [1.0] * 3
    assert dive.seam_m() < seam / 5


def test_a_believed_loop_that_the_map_turns_against_is_dropped() -> None:
    dive = Dive(100, seed=7)
    # Wrong by what the chain may have drifted: nothing speaks against it yet.
    wrong = dive.graph.pose(10).inverse() @ dive.graph.pose(80)
    wrong = wrong @ Sim3.exp(np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    dive.graph.add_edge(Edge(10, 80, wrong, np.diag(LOOP_SIGMA**-2), loop=True))
    assert list(dive.graph.optimise().trust.values()) == [1.0]
    for pair in [(9, 81), (11, 79), (8, 82), (12, 78), (7, 83), (13, 77)]:
        dive.close(pair)
        trust = list(dive.graph.optimise().trust.values())
    assert trust == [0.0] + [1.0] * 6
    assert dive.ate_m() < 0.1


def test_the_surest_loops_close_first_and_tell_the_others_apart() -> None:
    alone, among = Dive(100, seed=9), Dive(100, seed=9)
    for dive in (alone, among):
        wrong = dive.graph.pose(10).inverse() @ dive.graph.pose(80)
        wrong = wrong @ Sim3.exp(np.array([1.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        dive.graph.add_edge(Edge(10, 80, wrong, np.diag(LOOP_SIGMA**-2), loop=True))
    among.close((0, 99), (1, 98), (9, 81))
    assert list(alone.graph.optimise().trust.values()) == [1.0]
    assert list(among.graph.optimise().trust.values()) == [0.0, 1.0, 1.0, 1.0]
    assert among.ate_m() < alone.ate_m() / 3


def test_a_second_way_between_sub_maps_is_weighed_against_the_first() -> None:
    dive = Dive(40, noise=0.0)
    graph = dive.graph
    for number in range(40, 60):
        graph.add_keyframe(number, Sim3.exp(np.array([0.5 * number, 0, 0, 0, 0, 0, 0])))
        if number > 40:
            step = Sim3.exp(np.array([0.5, 0, 0, 0, 0, 0, 0]))
            graph.add_edge(Edge(number - 1, number, step, np.diag(LOOP_SIGMA**-2)))
    information = np.diag(LOOP_SIGMA**-2)
    graph.add_edge(Edge(20, 40, Sim3.identity(), information, loop=True))
    graph.add_edge(Edge(5, 50, Sim3.exp(np.full(7, 0.3)), information, loop=True))
    trust = list(graph.optimise().trust.values())
    assert trust == [1.0, 0.0]
