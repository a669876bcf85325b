"""Where a ray meets the map, and what is measured between such points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.survey.measure.quantity import Scale
from aquaflow.survey.viewer.measuring import LengthUnit, MeasuringScene, measure, ray_of
from aquaflow.survey.viewer.picking import pick, within_reach
from aquaflow.survey.viewer.section import section
from aquaflow.telemetry.world_frame import WorldFrame
from tests.survey.viewer.planes import DEPTH, floor

EYE = np.array([0.3, -0.2, 0.0])
UP = np.array([0.0, 0.0, -1.0])
METRES = LengthUnit(Scale("m", 0.0, 0.0), has_vertical=True)


def scene(frame: LengthUnit = METRES) -> MeasuringScene:
    return MeasuringScene(floor(), np.zeros((1, 3)), 1.0, UP, frame)


def point(x: float, y: float) -> dict[str, Any]:
    """What the page sends of a point of the floor."""
    direction = np.array([x, y, DEPTH]) - EYE
    found = pick(floor(), EYE, direction, 1e-3)
    return {
        "place": found.place.tolist(), "sigma": found.sigma, "origin": EYE.tolist(),
        "direction": direction.tolist(), "pixel_rad": 1e-3,
    }  # fmt: skip


@pytest.mark.parametrize("target", [(0.0, 0.0), (1.23, -2.1), (-3.0, 3.0)])
def test_a_ray_meets_a_plane_where_it_is(target: tuple[float, float]) -> None:
    direction = np.array([*target, DEPTH]) - EYE
    found = pick(floor(), EYE, 7.0 * direction, 1e-3)
    assert np.allclose(found.place, [*target, DEPTH], atol=0.02)
    assert np.isclose(found.range, np.linalg.norm(direction), atol=0.02)
    assert 1e-3 * found.range <= found.sigma < 0.05


def test_what_stands_before_the_plane_is_met_first() -> None:
    from dataclasses import replace

    plane = floor()
    centres = plane.centres.copy()
    centres[:, 2] = np.where(np.arange(len(centres)) % 2 == 0, DEPTH, DEPTH / 2)
    found = pick(replace(plane, centres=centres), np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0)
    assert np.isclose(found.place[2], DEPTH / 2, atol=0.02)


@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (9.0, 0.0, 1.0)])
def test_where_nothing_is_mapped_nothing_is_found(direction: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="nothing there"):
        pick(floor(), EYE, np.array(direction), 1e-3)


def test_between_gaussians_that_are_smaller_than_a_pixel_there_is_the_surface_too() -> None:
    dots = floor(step=0.1)
    dots.scales[:] = 0.005
    between = np.array([0.05, 0.05, DEPTH]) - EYE
    with pytest.raises(InputError, match="nothing there"):
        pick(dots, EYE, between, 1e-4)
    assert np.isclose(pick(dots, EYE, between, 0.015).place[2], DEPTH, atol=0.02)


def test_a_faint_map_is_no_surface() -> None:
    with pytest.raises(InputError, match="nothing there"):
        pick(floor(step=0.5, opacity=0.05), EYE, np.array([0.0, 0.0, 1.0]), 1e-3)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (np.nan, 0.0, 1.0)])
def test_a_ray_that_is_none_is_refused(direction: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="is none"):
        pick(floor(), EYE, np.array(direction), 1e-3)


def test_rays_in_a_plane_need_few_gaussians_and_meet_the_same() -> None:
    plane = floor()
    near = within_reach(plane, EYE, np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), 0.01)
    assert 0 < len(near) < len(plane) / 10
    direction = np.array([0.4, 0.0, 1.0])
    assert np.allclose(
        pick(near, EYE, direction, 0.0).place, pick(plane, EYE, direction, 0.0).place, atol=1e-5
    )


def test_two_points_are_a_distance_with_its_sigma() -> None:
    said = measure("distance", [point(0.0, 0.0), point(3.0, 0.0)], scene())
    length = said["quantities"]["distance"]
    assert np.isclose(length["value"], 3.0, atol=0.03)
    assert 0.0 < length["sigma"] < 0.3
    assert "\u00b1" in said["words"]
    assert said["words"].endswith(" m")


def test_lengths_of_a_live_map_are_said_in_metres_once_they_are_known() -> None:
    ends = [point(0.0, 0.0), point(3.0, 0.0)]
    live = LengthUnit(Scale("m", 0.01, 0.0), metres=2.0)
    assert np.isclose(
        measure("distance", ends, scene(live))["quantities"]["distance"]["value"], 6.0, atol=0.06
    )
    unknown = measure("distance", ends, scene(LengthUnit.of(WorldFrame.unknown())))
    assert "map units" in unknown["words"]


def test_three_points_are_an_area() -> None:
    said = measure("area", [point(0, 0), point(2, 0), point(2, 2), point(0, 2)], scene())
    assert np.isclose(said["quantities"]["area"]["value"], 4.0, atol=0.05)
    assert set(said["quantities"]) == {"area", "on a chart"}


@pytest.mark.parametrize("level", [True, False])
def test_a_profile_of_a_plane_is_flat(level: bool) -> None:
    frame = LengthUnit(Scale("m", 0.0, 0.0), has_vertical=level)
    said = measure("profile", [point(-2.0, 1.0), point(2.0, 1.0)], scene(frame))
    line = said["profile"]
    assert len(line["along"]) == len(line["height"]) == 64
    assert np.isclose(line["along"][-1], 4.0, atol=0.05)
    assert np.ptp(line["height"]) < 0.05
    assert (np.array(line["high"]) > np.array(line["low"])).all()


@pytest.mark.parametrize("level", [True, False])
def test_a_cross_section_holds_what_lies_in_its_slice(level: bool) -> None:
    frame = LengthUnit(Scale("m", 0.0, 0.0), metres=2.0, has_vertical=level)
    said = section([point(-2.0, 1.0), point(2.0, 1.0)], 0.4, scene(frame))
    assert said["length"] == pytest.approx(8.0, abs=0.1)
    along, height, depth = (np.array(said[name]) for name in ("along", "height", "depth"))
    assert (np.diff(depth) <= 0.0).all()
    assert np.abs(depth).max() <= 0.2
    assert 0.0 <= along.min() < 0.1
    assert along.max() == pytest.approx(8.0, abs=0.1)
    assert np.abs(height).max() < (0.1 if level else 0.3)  # along the ray the slice is aslant
    assert len(along) == pytest.approx(81 * 4, rel=0.3)
    assert np.sqrt(said["xx"]).max() == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("thickness", [0, -1.0, None, "1", 10**400])
def test_a_cross_section_without_a_thickness_is_refused(thickness: object) -> None:
    with pytest.raises(InputError, match="positive length"):
        section([point(0, 0), point(1, 0)], thickness, scene())


def test_a_cross_section_of_nothing_or_upright_is_refused() -> None:
    above = point(0, 0) | {"place": [0.0, 0.0, 2.0]}
    with pytest.raises(InputError, match="above each other"):
        section([point(0, 0), above], 0.5, scene())
    beside = [point(0, 0) | {"place": [x, 90.0, 5.0]} for x in (0.0, 1.0)]
    with pytest.raises(InputError, match="nothing is mapped"):
        section(beside, 0.5, scene())


@pytest.mark.parametrize(
    "bad",
    [
        {"place": [0, 0]}, {"place": [0, 0, "x"]}, {"place": [0, 0, 1e400]}, {"sigma": -1.0},
        {"place": None}, {"sigma": None}, {"place": [0, 0, 10**400]}, {"sigma": True and "1"},
    ],
)  # fmt: skip
def test_a_point_that_is_none_is_refused_in_a_sentence(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        measure("distance", [point(0, 0), point(1, 0) | bad], scene())


def test_what_is_no_measurement_is_refused() -> None:
    with pytest.raises(InputError, match="neither a distance"):
        measure("weight", [point(0, 0), point(1, 0)], scene())
    with pytest.raises(InputError, match="three finite numbers"):
        ray_of({"origin": [0, 0, 0], "direction": "ahead", "pixel_rad": 0.001})
