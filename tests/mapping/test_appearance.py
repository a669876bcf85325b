"""What a map's restored colours are shown in: white balance and tone, judged once, kept with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from aquaflow.dive.map_file import read_map_file, summarise_water, write_map_file
from aquaflow.dive.results import medium_json
from aquaflow.mapping.appearance import choose, shown_tone
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import (
    RESTORED,
    drawn_without_water,
    restored_gaussians,
    restored_picture,
    to_bytes,
)
from aquaflow.mapping.scene import RenderedMap
from aquaflow.mapping.state import copy_map, deserialise, serialise
from aquaflow.render.contract import radiance
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import View
from aquaflow.survey.export.ortho.drawing import Colours
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.daylight import Depths
from aquaflow.water.illuminant import LUMINANCE
from aquaflow.water.tone import ShownTone, lightness
from tests.mapping.grey_floor import CAST, WATER, mapped
from tests.mapping.mapping_scenes import CAMERA, renderer, view_of
from tests.water.daylit import daylit_grey


def restored_of(mapper: Mapper) -> np.ndarray:
    """[n, 3] the map without water from its first view."""
    view = mapper.views[0]
    shown = mapper.show(view)
    image = drawn_without_water(mapper.scene, view, shown).image
    return picture_out(image)[picture_out(shown.alpha) > 0.9].astype(np.float64)


def test_neutral_undoes_the_cast_of_a_grey_scene_and_keeps_its_luminance() -> None:
    mapper = mapped()
    choose(mapper, "camera")
    before = restored_of(mapper).mean(axis=0)
    assert before[2] / before[0] == pytest.approx(CAST[2] / CAST[0], rel=0.1)
    choose(mapper, "neutral")
    after = restored_of(mapper).mean(axis=0)
    assert after.max() / after.min() < 1.1
    assert after @ LUMINANCE == pytest.approx(before @ LUMINANCE, rel=0.05)
    choose(mapper, "camera")
    np.testing.assert_allclose(restored_of(mapper).mean(axis=0), before)


def test_the_settings_of_the_map_choose_first() -> None:
    mapper = mapped("neutral")
    shown_tone(mapper)
    assert mapper.scene.balance is not None
    assert mapper.scene.balance.chosen.name == "neutral"
    assert mapper.scene.balance.chosen.gain[0] > 1.5
    summary = summarise_water(mapper)
    assert summary is not None
    stated = medium_json(summary, WorldFrame.unknown())["restored"]
    np.testing.assert_allclose(stated["gain"], mapper.scene.balance.white, rtol=1e-6)
    assert stated["white_balance"]["choice"] == "neutral"
    np.testing.assert_allclose(
        stated["gain"], np.multiply(CAST, stated["white_balance"]["gain"]), rtol=1e-6
    )
    assert all(0.0 < sigma < 0.3 for sigma in stated["white_balance"]["sigma"])


def test_daylight_chosen_by_the_settings_waits_for_a_depth() -> None:
    mapper = mapped("DAYLIGHT:oceanic_II", light=daylit_grey(12.0))
    assert mapper.config.medium.white_balance == "daylight:oceanic_II"
    shown_tone(mapper)
    assert mapper.scene.balance is not None
    assert mapper.scene.balance.chosen.name == "camera"
    mapper.depths, mapper.tone = Depths(12.0, 0.5), None
    shown_tone(mapper)
    assert mapper.scene.balance.chosen.name == "daylight:oceanic_II"
    after = restored_of(mapper).mean(axis=0)
    assert after.max() / after.min() < 1.1


def test_daylight_of_no_named_water_goes_by_the_waters_own_attenuation() -> None:
    gains = []
    for rates in ((0.49, 0.17, 0.14), (0.88, 0.69, 0.88)):  # as oceanic II, as coastal 5C
        mapper = mapped("daylight", light=daylit_grey(12.0))
        assert mapper.scene.balance is not None
        mapper.medium.set_water(torch.tensor(rates), *(torch.tensor(each) for each in WATER[1:]))
        mapper.depths = Depths(12.0, 0.5)
        shown_tone(mapper)
        assert mapper.scene.balance.chosen.name == "daylight"
        gains.append(mapper.scene.balance.chosen.gain)
    red_over_blue = [red / blue for red, _, blue in gains]
    assert red_over_blue[0] > 1.3 * red_over_blue[1]


def test_a_channel_that_daylight_left_nothing_of_is_not_amplified() -> None:
    gains = []
    for red in (0.4, 0.004):
        mapper = mapped(light=daylit_grey(30.0))
        assert mapper.scene.balance is not None
        mapper.scene.balance = replace(mapper.scene.balance, mean=(red, 0.4, 0.4))
        mapper.depths = Depths(30.0, 0.5)
        choose(mapper, "daylight:oceanic_II")
        red_gain, green_gain, _ = mapper.scene.balance.chosen.gain
        gains.append(red_gain / green_gain)
    assert gains[0] > 2.0
    assert gains[1] < 1.2


def test_everything_that_shows_restored_colours_has_the_same_white_balance() -> None:
    mapper = mapped()
    J = radiance(mapper.gaussians.parameters["raw_colours"])

    def everywhere() -> list[np.ndarray]:
        mean = picture_out(J[:8]).reshape(1, 8, 3)
        ortho, _ = Colours(mapper, 1.0, None).of(torch.from_numpy(mean), np.full((1, 8), 2.0))
        return [
            restored_of(mapper).mean(axis=0),
            restored_gaussians(mapper.scene, J, mapper.views).numpy().mean(axis=0),
            copy_map(mapper).clear.mean(axis=0),
            ortho.reshape(-1, 3).mean(axis=0),
        ]

    choose(mapper, "camera")
    camera = everywhere()
    choose(mapper, "neutral")
    assert mapper.scene.balance is not None
    red_over_blue = mapper.scene.balance.chosen.gain[0] / mapper.scene.balance.chosen.gain[2]
    for before, after in zip(camera, everywhere(), strict=True):
        change = (after[0] / after[2]) / (before[0] / before[2])
        assert change == pytest.approx(red_over_blue, rel=0.06)


def counted(mapper: Mapper, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    drawn, show = [0], mapper.show

    def counting(view: View) -> RenderedMap:
        drawn[0] += 1
        return show(view)

    monkeypatch.setattr(mapper, "show", counting)
    return drawn


def test_the_tone_is_judged_once_and_anew_when_the_map_was_optimised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapper = mapped()
    drawn = counted(mapper, monkeypatch)
    tone = shown_tone(mapper)
    assert drawn[0] == 3
    assert shown_tone(mapper) == tone
    assert drawn[0] == 3
    mapper.optimiser.steps += 1
    shown_tone(mapper)
    assert drawn[0] == 6


def test_a_dive_without_water_is_shown_as_it_is_and_not_drawn_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapper = mapped()
    mapper.medium.active = False
    drawn = counted(mapper, monkeypatch)
    assert shown_tone(mapper) == ShownTone()
    assert copy_map(mapper).tone == ShownTone()
    assert drawn[0] == 0


def test_a_map_that_was_read_is_shown_as_it_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper = mapped("neutral")
    tone = shown_tone(mapper)
    write_map_file(tmp_path / "map.aqf", mapper)
    read = read_map_file(tmp_path / "map.aqf", renderer())
    drawn = counted(read, monkeypatch)
    assert shown_tone(read) == tone
    assert drawn[0] == 0
    assert read.scene.balance is not None
    assert mapper.scene.balance is not None
    assert read.scene.balance.white == mapper.scene.balance.white


def test_a_map_of_an_earlier_aquaflow_has_the_cameras_white_balance() -> None:
    facts, arrays = serialise(mapped())
    del facts["chosen_white"], facts["tone"]
    read = deserialise(facts, arrays, renderer())
    assert read.scene.balance is not None
    assert read.scene.balance.white == CAST
    shown_tone(read)


def test_before_the_first_fit_there_is_one_white_balance_only() -> None:
    mapper = mapped("neutral")
    mapper.scene.balance = None
    shown_tone(mapper)
    assert mapper.scene.balance is None


def test_a_scene_in_which_nothing_is_sure_keeps_the_cameras_white_balance() -> None:
    mapper = mapped()
    assert mapper.scene.balance is not None
    mapper.medium.set_water(*(torch.tensor(v) for v in ((9.0,) * 3, (0.2,) * 3, (5.0,) * 3)))
    choose(mapper, "neutral")
    assert mapper.scene.balance.white == CAST
    assert mapper.scene.balance.chosen.name == "camera"


def test_the_colours_of_a_copy_are_as_light_as_they_were_seen() -> None:
    mapper = mapped()
    assert mapper.scene.balance is not None
    dark = tuple(0.4 * gain for gain in CAST)
    mapper.scene.balance = replace(mapper.scene.balance, gain=dark)
    copy = copy_map(mapper)
    assert copy.tone.exposure > 1.2
    J = radiance(mapper.gaussians.parameters["raw_colours"])
    plain = restored_gaussians(mapper.scene, J, mapper.views).numpy()
    np.testing.assert_allclose(copy.clear, copy.tone.of(plain), atol=1e-5)
    assert lightness(copy.clear).mean() > 1.1 * lightness(plain).mean()


def test_pictures_are_as_light_as_they_were_seen_whose_detail_the_map_lacks() -> None:
    mapper = mapped()
    assert mapper.scene.balance is not None
    dark = tuple(0.6 * gain for gain in CAST)
    mapper.scene.balance = replace(mapper.scene.balance, gain=dark)
    pattern = torch.rand(
        (CAMERA.height, CAMERA.width, 1), generator=torch.Generator().manual_seed(2)
    )
    drawn = [mapper.show(view).image for view in mapper.views]
    coarse = [image * (0.4 + 1.2 * pattern) for image in drawn]
    mapper.views = [
        view_of(to_bytes(picture_out(image)), view.T_wc, view.frame_index)
        for image, view in zip(coarse, mapper.views, strict=True)
    ]
    tone = shown_tone(mapper)
    seen, restored = [], []
    for view in mapper.views:
        picture = restored_picture(mapper.scene, view, mapper.show(view))
        judged = picture_out(picture.confidence) > RESTORED
        seen.append(lightness(picture_out(view.target()))[judged])
        restored.append(lightness(tone.of(picture_out(picture.image)))[judged])
    assert tone.exposure > 1.2
    assert np.concatenate(restored).mean() == pytest.approx(np.concatenate(seen).mean(), abs=0.15)
