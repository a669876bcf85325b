"""The colour of the light: found in pictures, and made grey as far as it is known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.water.illuminant import (
    CAMERA_ERROR,
    LUMINANCE,
    SCENE_ERROR,
    Illuminant,
    gain_to_grey,
    illuminant_of,
    methods_in,
)

Array = npt.NDArray[np.float64]
CAST = np.array([0.45, 1.1, 1.3])
NO_NOISE = np.zeros(3)


def grey_scene(seed: int = 0) -> Array:
    """[60, 80, 3] of blocks of grey of other brightnesses."""
    blocks = np.random.default_rng(seed).uniform(0.1, 0.7, (12, 16, 1))
    return np.repeat(np.repeat(blocks, 5, axis=0), 5, axis=1) * np.ones(3)


def said_of(picture: Array, weight: Array | None = None) -> Array:
    found = methods_in(picture, np.ones(picture.shape[:2]) if weight is None else weight)
    assert found is not None
    return found


def light_of(*pictures: Array) -> Illuminant:
    light = illuminant_of([said_of(picture) for picture in pictures], [1.0] * len(pictures))
    assert light is not None
    return light


def test_every_method_finds_the_cast_of_a_grey_scene() -> None:
    wanted = np.log(CAST) - np.log(CAST).mean()
    for said in said_of(grey_scene() * CAST):
        np.testing.assert_allclose(said, wanted, atol=1e-3)


def test_the_gain_takes_the_cast_off_and_keeps_the_mean_luminance() -> None:
    seen = grey_scene() * CAST
    mean = seen.mean(axis=(0, 1))
    gain, sigma = gain_to_grey(light_of(seen, grey_scene(1) * CAST), NO_NOISE, mean)
    shown = mean * gain
    assert shown.max() / shown.min() == pytest.approx(1.0, abs=0.01)
    assert shown @ LUMINANCE == pytest.approx(mean @ LUMINANCE)
    assert max(sigma) < 0.05


def test_coloured_life_on_grey_ground_hardly_turns_what_is_found() -> None:
    scene = grey_scene()
    scene[:20, :30] *= (1.0, 0.45, 0.3)  # a sponge
    gain, _ = gain_to_grey(light_of(scene), NO_NOISE, scene.mean(axis=(0, 1)))
    assert max(gain) / min(gain) < 1.15


def test_pixels_without_weight_say_nothing() -> None:
    scene, weight = grey_scene(), np.ones((60, 80))
    scene[:30] *= (0.1, 0.2, 1.4)
    weight[:30] = 0.0
    np.testing.assert_allclose(said_of(scene, weight), 0.0, atol=1e-3)


@pytest.mark.parametrize(
    "picture", [np.zeros((60, 80, 3)), grey_scene() * (0.0, 1.0, 1.0), np.full((60, 80, 3), 0.4)]
)
def test_a_picture_that_says_nothing_of_a_channel_is_not_asked(picture: Array) -> None:
    assert methods_in(picture, np.ones((60, 80))) is None


def test_nothing_to_look_at_is_no_light() -> None:
    assert methods_in(grey_scene(), np.zeros((60, 80))) is None
    assert illuminant_of([], []) is None


def test_what_methods_and_pictures_disagree_on_is_uncertain_and_changed_less() -> None:
    one = light_of(grey_scene() * CAST)
    apart = light_of(grey_scene() * CAST, grey_scene(1) * (1.3, 1.1, 0.45))
    assert apart.sigma[0] > 0.3 > 10.0 * one.sigma[0]
    log = np.log(CAST) - np.log(CAST).mean()
    mean = np.full(3, 0.3)
    certain, unsure = (
        gain_to_grey(Illuminant(log, np.full(3, each)), NO_NOISE, mean)[0] for each in (0.0, 0.5)
    )
    assert np.log(unsure[0] / unsure[2]) == pytest.approx(0.5 * np.log(certain[0] / certain[2]))


def test_a_channel_without_light_is_not_amplified_beyond_its_bound() -> None:
    """The less red comes back the more it would take; of its noise it is not made."""
    gains = []
    for red in np.geomspace(1e-4, 0.3, 60):
        seen = np.array([red, 0.3, 0.3])
        light = Illuminant(np.log(seen) - np.log(seen).mean(), np.zeros(3))
        gain, sigma = gain_to_grey(light, 0.01 / seen, seen)
        gains.append(gain[0] / gain[1])
        assert sigma[0] <= CAMERA_ERROR
    assert max(gains) < 6.0
    assert gains[0] < 1.01
    assert gains[-1] == pytest.approx(1.0)
    assert max(gains) > 4.0  # and of what is there, use is made


def test_that_a_scene_may_not_be_grey_is_stated_and_changes_no_gain() -> None:
    light, mean = light_of(grey_scene() * CAST), np.full(3, 0.3)
    plain, wide = (gain_to_grey(light, NO_NOISE, mean, each) for each in (0.0, SCENE_ERROR))
    assert plain[0] == wide[0]
    assert max(plain[1]) < 0.05 < SCENE_ERROR <= min(wide[1])
