"""Light of lamps beside the camera in synthetic dives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.integrate import quad

from aquaflow.lab.synthetic.config import Lamps, SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.lab.synthetic.lamps import (
    BACKWARD_PER_SR,
    NEAREST_M,
    SCATTERED_SHARE,
    SyntheticLampLight,
)
from aquaflow.lab.synthetic.truth import read_truth
from aquaflow.lab.synthetic.water import WATER_TYPES, Medium

AT_CAMERA = Lamps(ambient=0.0, even_m=1.0, places_m=((0.0, 0.0, 0.0),), half_angle_deg=60.0)
AHEAD = np.array([[0.0, 0.0, 1.0]])
CLEAR = WATER_TYPES["clear"]


def _light(lamps: Lamps, medium: Medium = CLEAR) -> SyntheticLampLight:
    return SyntheticLampLight.of_camera(lamps, medium, np.eye(3), np.zeros(3))


def _seen(light: SyntheticLampLight, distance: float, J: float = 0.5) -> np.ndarray:
    """[3] a surface ahead that faces the camera."""
    t = np.array([distance])
    return light.compose(np.full((1, 3), J), np.zeros(3), AHEAD, t, -AHEAD)[0]


def test_light_of_a_lamp_falls_with_the_square_of_the_distance() -> None:
    light = _light(AT_CAMERA)
    np.testing.assert_allclose(_seen(light, 1.0), 0.5, rtol=1e-5)
    np.testing.assert_allclose(_seen(light, 2.0), 0.125, rtol=1e-5)


def test_a_lamp_is_half_as_bright_at_its_half_angle_and_dark_behind() -> None:
    light = _light(AT_CAMERA)
    ray = np.array([[np.sin(np.pi / 3), 0.0, 0.5]])
    J, at = np.ones((1, 3)), np.array([1.0])
    aside = light.compose(J, np.zeros(3), ray, at, -ray)
    behind = light.compose(J, np.zeros(3), -AHEAD, at, AHEAD)
    np.testing.assert_allclose(aside, 0.5, rtol=1e-5)
    np.testing.assert_array_equal(behind, 0.0)


def test_a_surface_turned_away_by_60_degrees_gets_half_the_light() -> None:
    normal = np.array([[np.sin(np.pi / 3), 0.0, -0.5]])
    seen = _light(AT_CAMERA).compose(np.ones((1, 3)), np.zeros(3), AHEAD, np.ones(1), normal)
    np.testing.assert_allclose(seen, 0.5, rtol=1e-5)


def test_water_takes_from_lamp_light_on_both_ways_and_returns_it_along_the_ray() -> None:
    water, z = WATER_TYPES["coastal_3C"], 2.0
    beta = np.array(water.beta_a)
    lamps = AT_CAMERA.model_copy(update={"places_m": ((0.3, 0.0, 0.0),)})

    def returned(s: float, c: int) -> float:
        r = np.hypot(0.3, s)
        return s / r / r**2 * np.exp(-beta[c] * (r + s))

    share = np.pi * BACKWARD_PER_SR * SCATTERED_SHARE * beta
    veil = share * [quad(returned, NEAREST_M, z, (c,))[0] for c in range(3)]
    light = _light(lamps, water)
    np.testing.assert_allclose(_seen(light, z, J=0.0), veil, atol=1e-4)
    r = np.hypot(0.3, z)
    direct = 0.5 * (z / r) ** 2 / r**2 * np.exp(-beta * (r + z))
    np.testing.assert_allclose(_seen(light, z) - _seen(light, z, J=0.0), direct, rtol=1e-4)


def test_by_full_daylight_lamps_change_nothing(tmp_path: Path) -> None:
    small = {"frames": 2, "width": 64, "height": 48}
    for name, lamps in (("lamps", Lamps(ambient=1.0)), ("none", None)):
        write_dive(tmp_path / name, SyntheticConfig(**small, lamps=lamps))
    a, b = read_truth(tmp_path / "lamps"), read_truth(tmp_path / "none")
    np.testing.assert_allclose(a.image(1), b.image(1), atol=1.01 / 255.0)
    assert a.medium == b.medium


def test_by_night_the_clean_picture_is_that_of_daylight_and_far_ground_is_dark(
    tmp_path: Path,
) -> None:
    small = {"frames": 2, "width": 64, "height": 48}
    write_dive(tmp_path / "night", SyntheticConfig(**small, lamps=Lamps(ambient=0.0)))
    write_dive(tmp_path / "day", SyntheticConfig(**small))
    night, day = read_truth(tmp_path / "night"), read_truth(tmp_path / "day")
    np.testing.assert_array_equal(night.clean(0), day.clean(0))
    assert night.medium.B_inf == (0.0, 0.0, 0.0)
    z = night.range_m(0)
    near, far = z < np.quantile(z, 0.2), z > np.quantile(z, 0.8)
    by_night, by_day = (
        dive.image(0)[far].mean() / dive.image(0)[near].mean() for dive in (night, day)
    )
    assert by_night < 0.5 * by_day
