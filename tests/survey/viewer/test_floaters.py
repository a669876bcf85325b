"""What no camera saw more than a sliver of is found; what the cameras were shown stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import PlyGaussians
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.viewer.finished import finished_dive
from aquaflow.survey.viewer.floaters import find_floaters
from aquaflow.survey.viewer.measuring import box_of
from aquaflow.survey.viewer.packing import Packed
from aquaflow.survey.viewer.tools import Tools
from aquaflow.survey.viewer.viewer_content import ShownMap, ViewerContent
from tests.survey.viewer.planes import DEPTH, floor

CAMERA = CameraModel(480, 360, 480.0, 480.0, 240.0, 180.0)
POSES = [Sim3(np.eye(3), np.array([x, 0.0, 0.0])) for x in (-0.5, 0.0, 0.5)]
"""Above the floor, straight down; they see |x| <= 3 and |y| <= 1.9 of it."""


def gaussians(*more: tuple[tuple[float, float, float], tuple[float, float, float]]) -> PlyGaussians:
    """The floor, and Gaussians of these centres and sizes beside it."""
    plane = floor(step=0.1)
    means, scales = (np.array([each[k] for each in more]).reshape(-1, 3) for k in range(2))
    return PlyGaussians(
        np.concatenate([plane.centres, means]),
        np.concatenate([plane.wxyz, np.tile([1.0, 0.0, 0.0, 0.0], (len(more), 1))]),
        np.concatenate([plane.scales, scales]),
        np.concatenate([plane.opacities, np.full(len(more), 0.9)]),
        np.concatenate([plane.colours, np.full((len(more), 3), 0.5)]),
    )


NEEDLE = (0.0, 0.0, 4.5), (0.015, 0.015, 1.2)
"""Seen end on by the camera above it."""
BEYOND = (4.0, 0.0, 5.0), (0.05, 0.6, 0.3)
"""At the map's edge, outside of every picture but for a tail."""
BEHIND = (0.0, 0.0, 6.0), (0.5, 0.5, 0.5)
"""Under the floor."""


@pytest.mark.parametrize("size", [1.0, 100.0, 0.01])
def test_what_no_camera_saw_more_than_a_sliver_of_is_found_in_any_unit(size: float) -> None:
    map_ = gaussians(BEYOND, BEHIND)
    scaled = replace(map_, means=size * map_.means, scales=size * map_.scales)
    found = find_floaters(scaled, [Sim3(T.R, size * T.t) for T in POSES], CAMERA)
    assert found[-2:].all()
    seen = (np.abs(map_.means[:, 0]) < 2.5) & (np.abs(map_.means[:, 1]) < 1.5)
    assert not found[:-2][seen[:-2]].any()


def test_a_needle_along_the_ray_is_found_and_one_across_it_is_not() -> None:
    across = (0.5, 0.0, 4.5), (1.2, 0.015, 0.015)
    found = find_floaters(gaussians(NEEDLE, across), POSES[1:2], CAMERA)
    assert found[-2:].tolist() == [True, False]


def test_what_is_far_from_every_camera_that_draws_is_not_judged() -> None:
    """Of a long path only some cameras draw the map."""
    many = [Sim3(np.eye(3), np.array([100.0, 0.0, 0.0]))] * 127
    assert not find_floaters(gaussians(BEHIND), [*many, POSES[1]], CAMERA)[-1]


def test_a_map_without_cameras_or_of_nothing_finite_has_none() -> None:
    assert not find_floaters(gaussians(BEHIND), [], CAMERA).any()
    nothing = gaussians(BEHIND)
    nothing.means[:] = np.nan
    assert not find_floaters(nothing, POSES, CAMERA).any()


def test_a_dives_floaters_come_first_and_the_page_knows_how_many(small_dive: Path) -> None:
    splats = finished_dive(Dive(small_dive), budget=100_000).splats
    assert 0 < splats.floaters < 0.05 * len(splats)
    surface = splats.weights()[splats.floaters :]
    assert (np.diff(surface) <= 0.0).all()
    about = Packed(splats).description()
    assert about["floaters"] == splats.floaters
    assert np.isclose(about["covered"][-1], 1.0)


def test_who_points_meets_only_what_lies_in_the_crop() -> None:
    plane = floor(step=0.1)
    content = ViewerContent("", (0.0, -1.0, 0.0))
    content.map = ShownMap(lambda: plane, Packed(plane), None, {})
    ask = Tools(exhibit=content).ask
    ray = {"origin": [0.0, 0.0, 0.0], "direction": [0.0, 0.0, 1.0], "pixel_rad": 0.001}
    beside, around = [[1.0, None, None], [None] * 3], [[None] * 3, [None, None, 5.1]]
    assert ask("pick", ray | {"box": around})["range"] == pytest.approx(DEPTH, rel=0.01)
    with pytest.raises(InputError, match="nothing there"):
        ask("pick", ray | {"box": beside})


@pytest.mark.parametrize("bad", [5, [], [[0, 0, 0]], [[0, 0], [1, 1]], [["a"] * 3, [None] * 3]])
def test_a_crop_that_is_no_box_is_refused(bad: object) -> None:
    with pytest.raises(InputError, match="reload the page"):
        box_of(bad)


def test_who_points_meets_a_floater_only_where_it_is_shown() -> None:
    plane = replace(floor(step=0.1), floaters=1)
    plane.centres[0], plane.scales[0] = (0.0, 0.0, 2.0), 0.2
    content = ViewerContent("", (0.0, -1.0, 0.0))
    content.map = ShownMap(lambda: plane, Packed(plane), None, {})
    tools = Tools(exhibit=content)
    ray = {"origin": [0.0, 0.0, 0.0], "direction": [0.0, 0.0, 1.0], "pixel_rad": 0.001}
    assert tools.ask("pick", ray)["range"] == pytest.approx(DEPTH, rel=0.01)
    assert tools.ask("pick", ray | {"all": True})["range"] == pytest.approx(2.0, rel=0.01)
