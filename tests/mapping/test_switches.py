"""Switches that the ablation turns: each one leaves out what it says, and nothing else."""

from __future__ import annotations

import numpy as np
import torch

from aquaflow.config import MediumConfig
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.water.estimation import models_for
from tests.mapping.mapping_scenes import (
    fit_water,
    flat_pointmap,
    floor,
    grown,
    path,
    picture,
    renderer,
    settings,
    view_of,
)
from tests.mapping.water.water_observations import B_RES, LAMP, D, estimate_water, sighted


def test_without_shading_the_fit_knows_no_lamp() -> None:
    seen = sighted(shading=LAMP)
    with_lamp = estimate_water(seen, B_RES, D)
    without = estimate_water(seen, B_RES, D, models_for(MediumConfig(shading=False)))
    assert with_lamp is not None
    assert without is not None
    assert np.abs(with_lamp.shading).max() > 0.1
    assert not without.shading.any()


def test_without_fit_the_water_stays_where_it_began() -> None:
    mapper = grown(settings(medium={"fit": False}))
    before = {name: value.clone() for name, value in mapper.medium.state_dict().items()}
    assert fit_water(mapper.scene, mapper.views, torch.Generator().manual_seed(0)) is None
    mapper.water_fitting.at_once(mapper.views)
    after = mapper.medium.state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())


def test_without_the_medium_in_insertion_new_gaussians_have_the_colours_that_were_seen() -> None:
    view = view_of(picture(floor(), path(1)[0]))
    brightness = {}
    for reduced in (True, False):
        config = settings(
            insertion={"density": 1.0, "bare_probability": 1.0, "medium_reduced": reduced},
            medium={"initial_attenuation": 0.5, "initial_B_inf": 0.01},
        )
        mapper = Mapper(config, renderer(), 0)
        assert mapper.insert(view, flat_pointmap()) > 0
        brightness[reduced] = float(mapper.gaussians.colours.mean())
    assert brightness[True] > 1.2 * brightness[False]
    assert abs(brightness[False] - float(view.target().mean())) < 0.05
