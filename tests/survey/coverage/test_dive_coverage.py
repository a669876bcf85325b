"""From a store of keyframes: what is read when, and keyframes that move or change their map."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.service import CoverageConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.survey.coverage import dive_coverage
from aquaflow.survey.coverage.dive_coverage import DiveCoverage
from aquaflow.survey.coverage.footprint import BLOCKS, Footprint
from tests.survey.coverage.surveys import ALTITUDE, CAMERA, above, metric

CONFIG = CoverageConfig()


def pointmap(depth: float = ALTITUDE, sigma: float = 0.01) -> Pointmap:
    shape = (CAMERA.height, CAMERA.width)
    return Pointmap(CAMERA, np.full(shape, 1 / depth), np.full(shape, (sigma / depth) ** 2))


class Told:
    """A keyframe whose pointmap counts who reads it."""

    def __init__(self, number: int, sub_map: int = 0) -> None:
        self.number, self.sub_map, self.T_wc = number, sub_map, above(0.0, 0.4 * number)
        self.read, self.lost = 0, False

    @property
    def pointmap(self) -> Pointmap:
        if self.lost:
            raise InputError("gone")
        self.read += 1
        return pointmap()


def store(count: int) -> Any:
    return SimpleNamespace(keyframes=[Told(number) for number in range(count)])


def look(coverage: DiveCoverage, keyframes: Any, everything: bool = False) -> None:
    coverage.look(keyframes, lambda _: metric(), everything)
    while coverage.update():
        pass


def test_a_block_has_the_mean_depth_of_what_is_known_in_it() -> None:
    known = pointmap(3.0)
    known.variance[: CAMERA.height // 2] = 1e6
    z = Footprint.of(known).z
    assert (z[: BLOCKS[0] // 2] == 0.0).all()
    assert z[BLOCKS[0] // 2 :] == pytest.approx(3.0, rel=1e-3)


def test_an_edge_between_near_and_far_is_not_bridged() -> None:
    z = np.full(BLOCKS, 2.0, np.float16)
    z[:, 12:] = 6.0
    corners, depths = Footprint(CAMERA, z).patches()
    assert len(corners) == BLOCKS[0] * (BLOCKS[1] - 2)
    assert set(depths) == {2.0, 6.0}


def test_a_pointmap_is_read_when_new_and_once_more_when_it_is_final() -> None:
    coverage, keyframes = DiveCoverage(CONFIG), store(3)
    for _ in range(3):
        look(coverage, keyframes)
    assert [each.read for each in keyframes.keyframes] == [1, 1, 3]
    keyframes.keyframes.append(Told(3))
    look(coverage, keyframes)
    look(coverage, keyframes)
    assert [each.read for each in keyframes.keyframes] == [1, 1, 4, 2]
    look(coverage, keyframes, everything=True)
    look(coverage, keyframes, everything=True)
    assert [each.read for each in keyframes.keyframes] == [1, 1, 4, 3]


def test_every_keyframe_that_moves_is_found_after_some_turns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dive_coverage, "FOLLOWED", 3)
    coverage, keyframes = DiveCoverage(CONFIG), store(12)
    look(coverage, keyframes, everything=True)
    for each in keyframes.keyframes:
        each.T_wc = Sim3(np.eye(3), np.array([4.0, 0.0, 0.0])) @ each.T_wc
    for _ in range(3):
        look(coverage, keyframes)
    assert {T.t[0] for _, T in coverage.sub_maps[0].seen.values()} == {4.0}


def test_after_a_restart_the_newest_are_read_first_a_few_at_a_time() -> None:
    coverage, keyframes = DiveCoverage(CONFIG), store(10)
    look(coverage, keyframes)
    assert sorted(coverage.sub_maps[0].seen) == [6, 7, 8, 9]
    for _ in range(3):
        look(coverage, keyframes)
    assert sorted(coverage.sub_maps[0].seen) == list(range(10))


def test_a_keyframe_whose_file_was_lost_shows_nothing() -> None:
    coverage, keyframes = DiveCoverage(CONFIG), store(3)
    keyframes.keyframes[1].lost = True
    look(coverage, keyframes)
    assert sorted(coverage.sub_maps[0].seen) == [0, 2]


def test_keyframes_that_move_or_change_their_sub_map_are_followed() -> None:
    coverage, keyframes = DiveCoverage(CONFIG), store(4)
    for each in keyframes.keyframes[2:]:
        each.sub_map = 1
    look(coverage, keyframes)
    assert sorted(coverage.sub_maps[1].seen) == [2, 3]
    moved = Sim3(np.eye(3), np.array([5.0, 0.0, 0.0]))
    for each in keyframes.keyframes[2:]:
        each.sub_map, each.T_wc = 0, moved @ each.T_wc
    keyframes.keyframes[0].T_wc = moved @ keyframes.keyframes[0].T_wc
    look(coverage, keyframes)
    assert sorted(coverage.sub_maps[0].seen) == [0, 1, 2, 3]
    assert [coverage.sub_maps[0].seen[n][1].t[0] for n in (0, 1, 3)] == [5.0, 0.0, 5.0]
    layer = coverage.sub_maps[1].layer
    assert layer is not None
    assert len(layer.tiles) == 0
