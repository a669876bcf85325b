"""The mapper's insertion: only where range, water and mask allow it, and never beyond the cap."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import MappingConfig
from aquaflow.mapping.mapper import Mapper
from tests.mapping.mapping_scenes import (
    CAMERA,
    flat_pointmap,
    floor,
    path,
    picture,
    pose,
    renderer,
    settings,
    view_of,
)


def dense(**keys: object) -> MappingConfig:
    """Every pixel that may get a Gaussian gets one."""
    insertion = {"density": 1.0, "bare_probability": 1.0}
    stages = {"insertion": insertion, "medium": {"enabled": False}, **keys}
    return MappingConfig.model_validate(stages)


def test_only_pixels_of_known_range_get_gaussians() -> None:
    mapper, pointmap = Mapper(dense(), renderer(), 0), flat_pointmap()
    pointmap.variance[:, 20:] = 1.0
    pointmap.rho[:10] = 0.0
    assert mapper.insert(view_of(picture(floor(), path(1)[0])), pointmap) == 38 * 20
    at = CAMERA.project(mapper.gaussians.means.numpy())
    assert at[:, 0].max() < 20.0
    assert at[:, 1].min() > 10.0


def test_masked_pixels_get_no_gaussians() -> None:
    mapper, view = Mapper(dense(), renderer(), 0), view_of(picture(floor(), path(1)[0]))
    view.mask = np.zeros((48, 64), bool)
    view.mask[:, :16] = True
    assert mapper.insert(view, flat_pointmap()) == 48 * 16
    assert CAMERA.project(mapper.gaussians.means.numpy())[:, 0].max() < 16.0


def test_pixels_that_the_water_hides_get_no_gaussians() -> None:
    murky = dense(medium={"initial_attenuation": 2.0})  # exp(-4) arrives
    mapper, view = Mapper(murky, renderer(), 0), view_of(picture(floor(), path(1)[0]))
    assert mapper.insert(view, flat_pointmap()) == 0
    pointmap = flat_pointmap()
    pointmap.rho[:, :10] = 1.0  # exp(-2)
    assert mapper.insert(view, pointmap) > 0
    assert CAMERA.project(mapper.gaussians.means.numpy())[:, 0].max() < 10.0


def test_the_cap_is_hard_and_cuts_no_corner_of_the_picture_off() -> None:
    mapper = Mapper(dense(max_gaussians=1000), renderer(), 0)
    view = view_of(picture(floor(), path(1)[0]))
    assert mapper.insert(view, flat_pointmap()) == 1000
    rows = CAMERA.project(mapper.gaussians.means.numpy())[:, 1]
    assert 0.3 < float((rows > 24.0).mean()) < 0.7


def test_at_the_cap_what_is_least_worth_makes_room_where_the_picture_is_bare() -> None:
    for share, expected in ((0.1, 100), (0.0, 0)):
        config = dense(max_gaussians=1000)
        insertion = config.insertion.model_copy(update={"recycle": share})
        mapper = Mapper(config.model_copy(update={"insertion": insertion}), renderer(), 0)
        view = view_of(np.full((48, 64, 3), 120, np.uint8))
        mapper.insert(view, flat_pointmap())
        mapper.gaussians.parameters["opacity_logits"][:300] = -3.0
        elsewhere = view_of(view.image, pose((0.0, 0.0, -9.0)))
        elsewhere.keyframe = 1
        assert mapper.insert(elsewhere, flat_pointmap()) == expected
        assert len(mapper.gaussians) == len(mapper.optimiser.adam.steps) == 1000
        faint = mapper.gaussians.opacities < 0.1
        assert int(faint.sum()) == 300 - expected
        assert int((mapper.gaussians.keyframes == 1).sum()) == expected


def test_a_surface_elsewhere_than_the_map_says_gets_gaussians_again() -> None:
    mapper = Mapper(dense(), renderer(), 0)
    view = view_of(np.full((48, 64, 3), 120, np.uint8))
    first = mapper.insert(view, flat_pointmap())
    assert mapper.insert(view, flat_pointmap()) < 0.2 * first
    assert mapper.insert(view, flat_pointmap(depth=1.0)) > 0.5 * first


def test_the_priors_range_stays_with_the_view_even_when_nothing_is_inserted() -> None:
    mapper = Mapper(settings(insertion={"tau_a": 1.0}), renderer(), 0)
    view = view_of(np.full((48, 64, 3), 120, np.uint8))
    pointmap = flat_pointmap()
    pointmap.rho[0, 0] = 0.0
    assert mapper.insert(view, pointmap) == 0
    assert view.inverse_range is not None
    assert view.range_confidence is not None
    assert float(view.inverse_range[0, 0]) == 0.0
    assert float(view.range_confidence[0, 0]) == 0.0
    assert float(view.inverse_range[24, 32]) == pytest.approx(0.5, rel=1e-3)
    assert 0.9 < float(view.range_confidence[24, 32]) < 1.0


def test_new_gaussians_belong_to_the_views_keyframe() -> None:
    mapper = Mapper(dense(), renderer(), 0)
    view = view_of(picture(floor(), path(1)[0]))
    view.keyframe = 7
    mapper.insert(view, flat_pointmap())
    assert mapper.gaussians.keyframes.unique().tolist() == [7]


def test_new_gaussians_take_the_restored_colour_or_the_raw_one_as_the_config_says() -> None:
    brightness = []
    for reduced in (True, False):
        config = dense(medium={"initial_attenuation": 0.3})
        insertion = config.insertion.model_copy(update={"medium_reduced": reduced})
        mapper = Mapper(config.model_copy(update={"insertion": insertion}), renderer(), 0)
        mapper.insert(view_of(np.full((48, 64, 3), 153, np.uint8)), flat_pointmap())
        brightness.append(float(mapper.gaussians.colours.mean()))
    assert brightness[1] == pytest.approx(0.6, abs=1e-3)
    assert brightness[0] > 0.65
