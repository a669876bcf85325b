"""Links that agree are kept, the others are not, whatever their order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aquaflow.config import GraphConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import NAME, PlacesFile
from aquaflow.survey.site.joining import LEAST_AGREEING, Mask, agreement, compatible_links, join
from aquaflow.survey.site.joint_graph import (
    AGAINST_OTHERS,
    ALONE,
    JOINT_LINK,
    USED,
    JointGraph,
)
from aquaflow.tracking.graph.equations import poses_of
from aquaflow.tracking.graph.loop_admission import Chains
from aquaflow.tracking.graph.pose_graph import Edge, PoseGraph
from tests.survey.site.site_dives import Scene, stated_dive

SIGMA = 0.01


@st.composite
def relations(draw: st.DrawFn) -> Mask:
    count = draw(st.integers(0, 9))
    found = np.zeros((count, count), dtype=bool)
    for i in range(count):
        for j in range(i):
            found[i, j] = found[j, i] = draw(st.booleans())
    return found


@given(relations())
def test_all_that_are_kept_agree_with_each_other(compatible: Mask) -> None:
    verdict = agreement(compatible, [1.0] * len(compatible))
    for i in verdict.kept:
        assert all(compatible[i, j] for j in verdict.kept if j != i)
    assert sorted(verdict.kept + verdict.against) == list(range(len(compatible)))


@given(relations())
def test_none_that_agrees_with_all_kept_is_left_out(compatible: Mask) -> None:
    verdict = agreement(compatible, [1.0] * len(compatible))
    for i in verdict.against if verdict.kept else ():
        assert not all(compatible[i, j] for j in verdict.kept)


@given(relations())
def test_any_two_that_agree_are_enough(compatible: Mask) -> None:
    verdict = agreement(compatible, [1.0] * len(compatible))
    assert bool(verdict.kept) == bool(compatible.any())
    assert len(verdict.kept) in {0, *range(LEAST_AGREEING, len(compatible) + 1)}


@given(relations(), st.randoms(use_true_random=False))
def test_the_order_of_the_links_decides_nothing_where_strengths_differ(
    compatible: Mask, random: object
) -> None:
    strength = [float(2**i) for i in range(len(compatible))]
    order = list(range(len(compatible)))
    random.shuffle(order)  # type: ignore[attr-defined]
    verdict = agreement(compatible, strength)
    turned = agreement(compatible[np.ix_(order, order)], [strength[i] for i in order])
    assert len(turned.kept) == len(verdict.kept)


def linked(*claims: tuple[int, int, Sim3]) -> tuple[PoseGraph, np.ndarray]:
    """Two paths of four keyframes, the second (10 to 13) in a world of its own, and link rows."""
    graph = PoseGraph()
    information = np.eye(7) / SIGMA**2
    for first in (0, 10):
        for i in range(4):
            graph.add_keyframe(first + i, at(i, first))
        for i in range(3):
            T_ab = at(i, first).inverse() @ at(i + 1, first)
            graph.add_edge(Edge(first + i, first + i + 1, T_ab, information))
    probe = PoseGraph.of_tables(graph.tables(), graph.config)
    for b, a, T_ba in claims:
        probe.add_edge(Edge(b, a, T_ba, information, loop=True))
    return graph, probe.tables()["edges"][6:]


WORLD = Sim3.exp(np.array([3.0, 2.0, 1.0, 0.5, 0.4, 0.3, 0.7]))


def at(i: int, first: int) -> Sim3:
    """T_wc: both paths run along x, the second in the scene's place of the first's."""
    T = Sim3(np.eye(3), np.array([0.2 * i, 0.0, 0.0]))
    return WORLD @ T if first else T


def claim(b: int, a: int, off: Sim3 | None = None) -> tuple[int, int, Sim3]:
    """What keyframe ``b`` sees of ``a`` in truth, and ``off``."""
    truth = WORLD.inverse() @ at(b - 10, 10)
    return b, a, (off or Sim3.identity()) @ truth.inverse() @ at(a, 0)


def verdict_on(*claims: tuple[int, int, Sim3]) -> Mask:
    graph, rows = linked(*claims)
    tables = graph.tables()
    poses = poses_of(tables["nodes"])
    chains = Chains(poses, tables["edges"], np.arange(len(tables["edges"])))
    return compatible_links(poses, chains, rows, GraphConfig())


def test_true_links_agree_across_worlds_of_their_own() -> None:
    found = verdict_on(claim(10, 0), claim(11, 1), claim(13, 2))
    assert (found == ~np.eye(3, dtype=bool)).all()


@pytest.mark.parametrize("direction", range(7))
def test_a_link_that_is_off_in_any_direction_agrees_with_none(direction: int) -> None:
    off = Sim3.exp(0.4 * np.eye(7)[direction])
    found = verdict_on(claim(10, 0), claim(11, 1), claim(12, 2, off))
    assert found[0, 1]
    assert not found[2].any()


def test_a_pair_of_keyframes_cannot_confirm_itself() -> None:
    assert not verdict_on(claim(10, 0), claim(10, 0)).any()


def seen(joint: JointGraph, b: int, a: int, off: Sim3 | None = None) -> np.ndarray:
    """[1] JOINT_LINK: keyframe ``b`` of the second dive sees keyframe ``a`` of the first, in truth
    and ``off``."""
    row = np.zeros(1, JOINT_LINK)
    row["node_a"], row["node_b"], row["edge"], row["verdict"] = (
        joint.node(0, a), joint.node(1, b), -1, ALONE,
    )  # fmt: skip
    T_wa, T_wb = (joint.sub_maps[dive].starts.element(number) for dive, number in ((0, a), (1, b)))
    T_ba = T_wb.inverse() @ T_wa @ (off or Sim3.identity())
    row["R"], row["t"], row["scale"] = T_ba.R, T_ba.t, T_ba.scale
    row["a"], row["b"], row["inliers"] = a, b, 50
    row["information"] = np.eye(7) / SIGMA**2
    return row


@pytest.fixture
def two_dives(tmp_path: Path) -> JointGraph:
    joint, scene = JointGraph(), Scene(1)
    for name, start in (("a", 0.0), ("b", 0.4)):
        folder = stated_dive(tmp_path / name, scene, start)
        joint.add(name, PlacesFile(folder / NAME), {})
        join(joint, np.zeros(0, JOINT_LINK))
    return joint


def test_a_single_link_joins_nothing_until_another_agrees(two_dives: JointGraph) -> None:
    join(two_dives, seen(two_dives, 1, 3))
    assert len(two_dives.components()) == 2
    assert two_dives.links["verdict"].tolist() == [ALONE]
    join(two_dives, seen(two_dives, 3, 5))
    assert len(two_dives.components()) == 1
    assert two_dives.links["verdict"].tolist() == [USED, USED]


def test_false_links_never_join_what_they_do_not_agree_on(two_dives: JointGraph) -> None:
    rng = np.random.default_rng(3)
    for b, a in ((0, 1), (1, 3), (2, 0), (3, 5), (4, 2)):
        join(two_dives, seen(two_dives, b, a, Sim3.exp(rng.normal(0.0, 0.6, 7))))
    assert len(two_dives.components()) == 2
    join(two_dives, np.concatenate([seen(two_dives, b, b + 1) for b in range(3)]))
    assert len(two_dives.components()) == 1
    assert two_dives.links["verdict"].tolist() == [AGAINST_OTHERS] * 5 + [USED] * 3
