"""The tone of restored pictures: as light as the ground was seen, and no highlight cut off."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.water.tone import ShownTone, lightness, tone_of


def test_a_dive_that_is_light_enough_without_water_is_shown_as_it_is() -> None:
    seen, clear = np.full((1000, 3), 0.3), np.full((1000, 3), 0.3)
    clear[0] = 1.9  # a single bright pixel darkens no dive
    assert tone_of(seen, clear) == ShownTone()
    assert tone_of(seen[:0], clear[:0]) == ShownTone()
    clear[1], seen[2] = np.nan, np.inf
    assert tone_of(seen, clear) == ShownTone()


def test_what_is_brighter_than_white_without_water_is_drawn_together() -> None:
    seen, clear = np.full((100, 3), 0.3), np.full((100, 3), 0.3)
    clear[:10] = np.linspace(0.7, 1.9, 10)[:, None]
    tone = tone_of(seen, clear)
    assert tone.exposure == 1.0
    shown = tone.of(clear)
    assert shown.max() == pytest.approx(0.95, abs=0.01)
    assert (np.diff(shown[:10, 0]) > 0.0).all()
    np.testing.assert_array_equal(shown[10:], clear[10:])


def test_a_dive_that_is_darker_without_its_veil_is_shown_as_light_as_it_was_seen() -> None:
    random = np.random.default_rng(0)
    clear = random.uniform(0.02, 0.25, (1000, 3))
    seen = 0.6 * clear + 0.2
    tone = tone_of(seen, clear)
    assert 1.0 < tone.exposure < 4.0
    assert lightness(tone.of(clear)).mean() == pytest.approx(lightness(seen).mean(), abs=0.1)
    assert tone.of(clear).max() < 0.96


def test_bright_places_bound_how_light_a_dive_is_shown() -> None:
    clear = np.full((1000, 3), 0.1)
    clear[:50] = 0.8
    tone = tone_of(np.full((1000, 3), 0.3), clear)
    assert tone.exposure == pytest.approx(1.25 / 0.8)
    assert tone.of(clear).max() == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("colour", [(0.2, 0.3, 0.4), (0.5, 0.5, 0.5), (0.9, 0.1, 0.2)])
def test_lightness_is_that_of_cielab(colour: tuple[float, float, float]) -> None:
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]
    Y = float(np.dot((0.2126, 0.7152, 0.0722), linear))
    wanted = 116.0 * np.cbrt(Y) - 16.0
    assert lightness(np.array([colour]))[0] == pytest.approx(wanted, abs=0.2)
