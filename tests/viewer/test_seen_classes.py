"""Places of a map by how well they were seen: by how many views, from where, and how near."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from aquaflow.config.coverage import CoverageConfig
from aquaflow.coverage import Seen
from aquaflow.coverage.coverage_file import NAME, read_coverage_file
from aquaflow.fusion.metric_file import read_frame_of_map
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.viewer.dive_coverage import coverage_of_dive
from aquaflow.viewer.seen_classes import MOST_PLACES, coverage_level

CAMERA = CameraModel(100, 100, 100.0, 100.0, 50.0, 50.0)
UP = np.array([0.0, 0.0, -1.0])


def at(x: float) -> Sim3:
    """A camera that looks down from x; it sees half its height to either side."""
    return Sim3(np.eye(3), np.array([x, 0.0, 0.0]))


def seen(
    places: list[tuple[float, float, float]], views: list[Sim3], limit: float | None
) -> list[int]:
    found = coverage_level(
        np.array(places).reshape(-1, 3), views, CAMERA, UP, limit, CoverageConfig()
    )
    return found.tolist()


def test_what_several_views_see_from_several_sides_is_seen_well() -> None:
    views = [at(0.0), at(0.5), at(1.0)]
    found = seen([(0.5, 0.0, 2.0), (-0.9, 0.0, 2.0), (9.0, 0.0, 2.0)], views, None)
    assert found == [Seen.WELL, Seen.SPARSE, Seen.NOT]


def test_many_views_from_one_place_are_no_parallax() -> None:
    assert seen([(0.0, 0.0, 2.0)], [at(0.0)] * 9, None) == [Seen.SPARSE]


def test_beyond_the_waters_range_it_is_too_far() -> None:
    views = [at(0.0), at(0.5), at(1.0)]
    assert seen([(0.5, 0.0, 2.0), (0.5, 0.0, 6.0)], views, 3.0) == [Seen.WELL, Seen.TOO_FAR]


def test_what_lies_behind_the_camera_is_not_seen() -> None:
    assert seen([(0.0, 0.0, -2.0)], [at(0.0)] * 3, None) == [Seen.NOT]


def test_a_map_of_many_gaussians_is_classed_by_cubes_and_one_far_away_does_no_harm() -> None:
    rng = np.random.default_rng(0)
    centres = np.array([0.0, 0.0, 3.0]) + rng.uniform(-1.0, 1.0, (3 * MOST_PLACES, 3))
    centres[0] = (0.0, 0.0, 1e9)
    centres[1] = np.nan
    views = [at(-0.5), at(0.0), at(0.5)]
    found = coverage_level(centres, views, CAMERA, UP, None, CoverageConfig())
    assert found.shape == (3 * MOST_PLACES,)
    inside = np.abs(centres[:, 0]) < 0.4
    assert (found[inside] == Seen.WELL).mean() > 0.9


def test_an_empty_map_has_no_classes() -> None:
    assert seen([], [at(0.0)], None) == []


def test_a_finished_dive_takes_its_own_plan_and_a_damaged_one_costs_itself(
    small_dive: Path, tmp_path: Path
) -> None:
    dive = shutil.copytree(small_dive, tmp_path / "dive")
    frame = read_frame_of_map(dive / "map.aqf")
    plan = read_coverage_file(dive / NAME)[0].plan
    i, j = np.argwhere(plan.classes == Seen.WELL)[0]
    place_g = np.array([*plan.corner, 0.0]) + plan.cell * np.array([j + 0.5, i + 0.5, 0.0])
    place_n = frame.T_nm.apply((plan.frame.R_gm.T @ place_g)[None])
    asked = (place_n, [Sim3(np.eye(3), np.array([1e6, 0.0, 0.0]))], CAMERA, frame, None)
    assert coverage_of_dive(dive, *asked) == [Seen.WELL]
    (dive / NAME).write_bytes(b"no file")
    assert coverage_of_dive(dive, *asked) == [Seen.NOT]  # by the one keyframe, far away
    assert coverage_of_dive(dive, asked[0], [], CAMERA, frame, None) is None
