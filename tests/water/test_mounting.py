"""Lamps beside the camera, on ground that turns away: what they do is no water."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.water.model import Model, Trial, WaterModel
from aquaflow.water.mounting import START, Lamp, MountedLight
from aquaflow.water.observations import Observations
from tests.water.water_observations import (
    B_RES,
    BETA,
    D,
    assert_derivatives_are_finite_differences,
    fitted,
    sighted,
)

Array = npt.NDArray[np.float64]

MOUNTING = np.array([0.0, 2.0, -1.8, 0.02, -0.06])
"""A bare LED; nearly all Lambert's law; 0.17 of the median range aside, above the camera."""
GLOW = np.array([0.05, 0.04, 0.03])


def on_sloping_ground(points: int = 500) -> Observations:
    """What turns away the more the farther it is: flat ground below a camera that looks ahead."""
    daylight = sighted(points=points)
    rng = np.random.default_rng(3)
    ray = np.column_stack([0.7 * daylight.xy, np.ones(len(daylight.z))])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    tilt = 0.15 + 0.35 * daylight.z + 0.1 * rng.normal(size=len(daylight.z))
    aside = np.cross(ray, [1.0, 0.0, 0.0])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    normal = -np.cos(tilt)[:, None] * ray + np.sin(tilt)[:, None] * aside
    J = rng.uniform(0.0, 0.9, (points, 1)) * rng.uniform(0.7, 1.0, (points, 3))
    seen = replace(daylight, ray=ray, normal=normal)
    problem = WaterModel(seen, Model(water=True, lamp=True), B_RES, D)
    none = np.zeros(3)
    still = Trial(BETA, none, none, np.zeros(5), np.zeros(5), np.zeros((4, 3)))
    lamp = Lamp(0.8, 2.0, seen.median_range)
    light = problem.light_of(replace(still, glow=GLOW, mounting=MOUNTING), lamp)
    T = np.exp(-BETA * seen.z[:, None]) * (0.2 + light.beam.T)
    colour = J[seen.point] * T + light.glow.T + 0.003 * rng.normal(size=J[seen.point].shape)
    return replace(seen, colour=colour)


def test_attenuation_is_told_from_where_lamps_are_and_how_ground_faces_them() -> None:
    seen = on_sloping_ground()
    found = fitted(seen)
    assert found.lamp is not None
    error = np.abs(np.log(found.beta_a / BETA))
    assert (error < 0.1).all()
    assert found.beta_a_sigma is not None
    assert (error < 3.0 * np.array(found.beta_a_sigma)).all()
    at_the_camera = fitted(replace(seen, ray=None, normal=None))
    assert np.abs(np.log(at_the_camera.beta_a / BETA)).max() > 3.0 * error.max()


def test_pictures_that_know_no_normals_are_restored_evenly_over_range() -> None:
    found = fitted(on_sloping_ground())
    assert found.lightness_over_range is not None
    assert found.lightness_over_range[0] < 0.7
    assert found.lightness_over_range[1] == pytest.approx(1.0, abs=0.05)


def test_where_lamps_are_is_known_with_its_deviation() -> None:
    seen = on_sloping_ground()
    lamp = fitted(seen).lamp
    assert lamp is not None
    assert lamp.places is not None
    assert lamp.places_sigma is not None
    aside, right, down = np.exp(MOUNTING[2]), *MOUNTING[3:]
    true = seen.median_range * np.array([[right - aside, down], [right + aside, down]])
    assert (np.abs(lamp.places - true) < 3.0 * np.array(lamp.places_sigma)).all()
    assert max(lamp.places_sigma) < 0.1 * seen.median_range
    assert lamp.share_sigma is not None
    assert 0.0 < lamp.share_sigma < 0.1


def test_a_lamp_is_read_as_it_was_written_and_its_lengths_change_their_unit() -> None:
    places = ((-0.2, 0.1), (0.2, 0.1))
    lamp = Lamp(0.8, 2.0, 1.5, share_sigma=0.02, places=places, places_sigma=(0.03, 0.01))
    assert Lamp.of(json.loads(json.dumps(asdict(lamp)))) == lamp
    twice = Lamp(0.8, 2.0, 3.0, 0.02, ((-0.4, 0.2), (0.4, 0.2)), (0.06, 0.02))
    assert lamp.rescale(2.0) == twice
    older = {"share": 0.8, "power": 2.0, "range": 1.5}
    assert Lamp.of(older) == Lamp(0.8, 2.0, 1.5)
    assert Lamp.of(older).rescale(2.0).places is None


def test_a_lamp_at_the_camera_that_shines_everywhere_changes_nothing() -> None:
    rng = np.random.default_rng(0)
    ray = np.column_stack([rng.uniform(-0.5, 0.5, (200, 2)), np.ones(200)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    z, beam, glow = rng.uniform(0.5, 2.0, 200), np.ones((3, 200)), np.ones((3, 200))
    basis = rng.normal(size=(5, 200))
    nowhere = np.array([-20.0, 0.0, -20.0, 0.0, 0.0])
    light = MountedLight(ray, -ray, z, basis).light(nowhere, beam, glow)
    np.testing.assert_allclose(light.beam, 1.0, rtol=1e-6)
    np.testing.assert_allclose(light.glow, 1.0, rtol=1e-6)


def test_what_the_water_returns_is_brighter_on_the_side_of_the_lamps() -> None:
    y, x = (each.reshape(-1) for each in np.mgrid[-1:1:15j, -1:1:15j])
    ray = np.stack([0.5 * x, 0.5 * y, np.ones(len(x))], axis=-1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    basis = np.stack([x, y, x * x, x * y, y * y])
    above = START + np.array([0.0, 0.0, 0.0, 0.0, -0.1])
    even = np.ones((3, len(x)))
    glow = MountedLight(ray, -ray, np.ones(len(x)), basis).light(above, even, even).glow[0]
    assert glow[y < -0.5].mean() > 1.1 * glow[y > 0.5].mean()


def test_by_lamps_what_is_brighter_than_white_is_no_evidence_against_the_water() -> None:
    lit = WaterModel(sighted(points=60), Model(water=True, lamp=True), B_RES, D)
    bright = np.full((3, 60), 2.5)
    dim = WaterModel(sighted(points=60), Model(water=True), B_RES, D)
    assert np.abs(lit.of_scene(bright)).sum() < np.abs(dim.of_scene(bright)).sum()


@pytest.mark.parametrize("c", range(3))
def test_derivatives_by_the_mounting_are_those_of_finite_differences(c: int) -> None:
    seen = on_sloping_ground(60)
    problem = WaterModel(seen, Model(water=True, shading=True, lamp=True), B_RES, D)
    assert_derivatives_are_finite_differences(problem, c, spread=0.05)
