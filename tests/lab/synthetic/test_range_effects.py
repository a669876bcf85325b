"""Blur and colours by range that no medium of the image formation explains."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import gamma

from aquaflow.lab.synthetic.config import Lamps, RangeEffects, SyntheticConfig
from aquaflow.lab.synthetic.dive import write_dive
from aquaflow.lab.synthetic.range_effects import spread, wideband_transmission
from aquaflow.lab.synthetic.water import WATER_TYPES

WATER = WATER_TYPES["coastal_1C"]
RANGES = np.linspace(0.0, 8.0, 9, dtype=np.float32)


def test_a_wide_band_transmits_the_mean_over_its_wavelengths() -> None:
    s, z = 0.6, 3.0
    beta = WATER.beta_a[0]
    band = gamma(1.0 / s**2, scale=beta * s**2)
    mean, _ = quad(lambda b: np.exp(-b * z) * band.pdf(b), 0.0, band.ppf(1.0 - 1e-12))
    given = wideband_transmission(WATER, np.array([z], np.float32), (s, s, s))
    np.testing.assert_allclose(given[0, 0], mean, rtol=1e-4)


def test_without_width_a_band_attenuates_as_the_medium_says() -> None:
    given = wideband_transmission(WATER, RANGES, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(given, WATER.transmission(RANGES), rtol=1e-4)


def test_attenuation_of_what_is_left_falls_with_range() -> None:
    left = np.log(wideband_transmission(WATER, RANGES, (0.6, 0.6, 0.6)).astype(np.float64))
    rates = -np.diff(left, axis=0)
    assert (np.diff(rates, axis=0) < 0.0).all()
    np.testing.assert_allclose(-np.diff(left[:2], axis=0)[0], WATER.beta_a, rtol=0.25)


def test_the_picture_of_a_point_grows_with_the_root_of_its_range() -> None:
    effects = RangeEffects(blur_mrad=4.0)
    widths = [_width_of_a_point(400.0 * effects.blur_rad(np.float32(z))) for z in (1.0, 4.0)]
    np.testing.assert_allclose(widths, [1.6, 3.2], rtol=0.03)


def test_no_light_is_lost_by_blur_and_none_changes_without_it() -> None:
    picture = np.random.default_rng(0).random((40, 50, 3), dtype=np.float32)
    np.testing.assert_array_equal(spread(picture, np.zeros((40, 50), np.float32)), picture)
    blurred = spread(picture, np.full((40, 50), 1.3, np.float32))
    np.testing.assert_allclose(blurred.mean(), picture.mean(), rtol=5e-3)
    assert blurred.std() < 0.5 * picture.std()


def test_effects_change_what_the_camera_sees_and_not_the_truth(tmp_path: Path) -> None:
    size = {"frames": 2, "width": 64, "height": 48}
    without, with_them = tmp_path / "without", tmp_path / "with"
    write_dive(without, SyntheticConfig.model_validate(size))
    write_dive(with_them, SyntheticConfig.model_validate({**size, "range_effects": {}}))

    def same(folder: str) -> bool:
        pairs = zip(
            sorted((without / folder).iterdir()),
            sorted((with_them / folder).iterdir()),
            strict=True,
        )
        return all(a.read_bytes() == b.read_bytes() for a, b in pairs)

    assert same("clean")
    assert same("range")
    assert not same("images")


def test_range_effects_beside_lamps_are_refused() -> None:
    with pytest.raises(ValueError, match="leave them or lamps out"):
        SyntheticConfig(range_effects=RangeEffects(), lamps=Lamps())


def _width_of_a_point(sigma_px: np.float32) -> float:
    picture = np.zeros((61, 61, 3), np.float32)
    picture[30, 30] = 1.0
    seen = spread(picture, np.full((61, 61), sigma_px, np.float32))[..., 0].astype(np.float64)
    x = np.arange(61) - 30.0
    return float(np.sqrt((seen.sum(0) * x**2).sum() / seen.sum()))
