"""The path from above: its axes, its bounds in points and in time, and what is not known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.live.plan_view import MOST_POINTS, PlanView
from aquaflow.telemetry.world_frame import WorldFrame

NORTH_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""n from a first camera that looks north: its z is n's x."""


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def scene(paths: dict[int, np.ndarray], frame: WorldFrame, latest: Any = None) -> Any:
    """What the view reads of a dive: ``paths`` [N, 3] of keyframes by sub-map."""
    keyframes = [
        SimpleNamespace(sub_map=number, T_wc=Sim3(np.eye(3), centre))
        for number, path in paths.items()
        for centre in path
    ]
    store = SimpleNamespace(keyframes=keyframes)
    slam = SimpleNamespace(keyframes=store, metric_frame=lambda _: frame)
    return SimpleNamespace(slam=slam, loop=SimpleNamespace(latest=latest))


def pose(R: np.ndarray, t: tuple[float, float, float], sub_map: int = 0) -> Any:
    return SimpleNamespace(T_wc=Sim3(R, np.array(t)), sub_map=sub_map)


def straight(count: int, axis: int) -> np.ndarray:
    path = np.zeros((count, 3))
    path[:, axis] = np.arange(count)
    return path


LEVEL = replace(
    WorldFrame.unknown(),
    T_nm=Sim3(NORTH_UP, np.zeros(3), 2.0),
    metric=True,
    level=True,
    north="true north",
)


def test_a_level_map_is_shown_in_metres_with_north_up() -> None:
    latest = pose(np.eye(3), (0.0, 0.0, 4.0))
    said = PlanView(lambda: scene({0: straight(3, 2)}, LEVEL, latest)).to_json()
    [plan] = said["sub_maps"]
    assert (plan["unit"], plan["seen"]) == ("m", "from above")
    assert (plan["right"], plan["up"]) == ("east", "true north")
    assert plan["points"] == [[0.0, 0.0], [0.0, 2.0], [0.0, 4.0]]
    assert said["now"] == {"sub_map": 0, "at": [0.0, 8.0], "ahead": [0.0, 1.0]}


def test_a_camera_that_looks_straight_down_looks_to_no_side() -> None:
    down = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    latest = pose(down, (0.0, 0.0, 0.0))
    assert PlanView(lambda: scene({0: straight(3, 2)}, LEVEL, latest)).to_json()["now"] == {
        "sub_map": 0, "at": [0.0, 0.0], "ahead": None,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("axis", "up", "last"),
    [(2, "ahead of it", [0.0, 2.0]), (1, "up", [0.0, -2.0])],
)
def test_without_gravity_the_plane_is_the_one_that_the_camera_moves_in(
    axis: int, up: str, last: list[float]
) -> None:
    said = PlanView(lambda: scene({0: straight(3, axis)}, WorldFrame.unknown())).to_json()
    [plan] = said["sub_maps"]
    assert (plan["unit"], plan["up"], plan["points"][-1]) == ("map units", up, last)
    assert said["now"] is None


def test_a_long_path_is_thinned_and_keeps_its_ends() -> None:
    paths = {0: straight(20_000, 2), 1: straight(1, 2)}
    first, second = PlanView(lambda: scene(paths, WorldFrame.unknown())).to_json()["sub_maps"]
    assert len(first["points"]) == MOST_POINTS
    assert (first["points"][0], first["points"][-1]) == ([0.0, 0.0], [0.0, 19_999.0])
    assert (second["number"], len(second["points"])) == (1, 1)


def test_it_is_computed_once_a_second_however_many_ask() -> None:
    clock, computed = Clock(), []

    def parts() -> Any:
        computed.append(clock.now)
        return scene({0: straight(2, 2)}, LEVEL)

    view = PlanView(parts, clock)
    for clock.now in (0.0, 0.2, 0.9, 1.0, 1.5, 2.1):
        view.to_json()
    assert computed == [0.0, 1.0, 2.1]


def test_without_a_dive_or_a_pose_there_is_no_path() -> None:
    assert PlanView(lambda: None).to_json() == {"sub_maps": [], "now": None}
    lost = SimpleNamespace(T_wc=None, sub_map=0)
    assert PlanView(lambda: scene({}, LEVEL, lost)).to_json()["sub_maps"] == []
