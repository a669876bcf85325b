"""Switches that the ablation turns: each one leaves out what it says, and nothing else."""

from __future__ import annotations

import numpy as np
import torch

from aquaflow.config import InsertionConfig, MediumConfig
from aquaflow.mapping.gaussians import colour_range, select
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.scene import orientations
from aquaflow.water.estimation import models_for
from tests.mapping.mapping_scenes import (
    filmed,
    fit_water,
    flat_pointmap,
    floor,
    grown,
    path,
    picture,
    pose,
    renderer,
    settings,
    view_of,
    water,
)
from tests.water.water_observations import B_RES, LAMP, D, estimate_water, sighted


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


def test_attenuation_follows_the_orientation_only_where_it_is_asked_to() -> None:
    ratio = {}
    for directional in (True, False):
        medium = {"fit": False, "directional": directional, "directional_rate": 1e-2}
        mapper = grown(settings(medium=medium))
        mapper.optimise(10)
        first, last = (mapper.scene.water(view) for view in (mapper.views[0], mapper.views[-1]))
        assert first is not None
        assert last is not None
        ratio[directional] = (first.beta_a / last.beta_a).log().abs().max().item()
    assert ratio[False] == 0.0
    assert ratio[True] > 1e-3


def test_what_the_orientation_says_survives_a_fit_of_the_water() -> None:
    poses = [pose((0.05 * i, 0.0, -0.15 * i), (0.0, 0.05 * i, 0.0)) for i in range(12)]
    mapper = Mapper(settings(medium={"directional": True}), renderer(), 0)
    for view in filmed(floor(), poses, water()):
        mapper.views.append(view)
    mapper.scene.gaussians.append(floor())
    with torch.no_grad():
        mapper.medium.output.weight.fill_(0.02)
    assert fit_water(mapper.scene, mapper.views, torch.Generator().manual_seed(0)) is not None
    assert bool((mapper.medium.output.weight == 0.02).all())
    found = mapper.medium(orientations(mapper.views, mapper.scene.device)).beta_a
    assert (found[0] / found[-1]).log().abs().max() > 1e-3


def test_above_a_threshold_every_pixel_gets_a_gaussian_whatever_is_drawn() -> None:
    P = torch.linspace(0.0, 1.0, 100).reshape(10, 10)
    allowed = torch.ones(10, 10, dtype=torch.bool)
    chosen = {}
    for selection in ("threshold", "random"):
        config = InsertionConfig.model_validate({"selection": selection, "tau_a": 0.4})
        chosen[selection] = [
            len(select(P, allowed, 1.0, config, torch.Generator().manual_seed(seed))[0])
            for seed in range(3)
        ]
    assert chosen["threshold"] == [int((P > 0.4).sum())] * 3
    assert all(0 < count < chosen["threshold"][0] for count in chosen["random"])


def test_the_papers_threshold_lets_no_gaussian_in() -> None:
    config = settings(insertion={"selection": "threshold", "tau_a": 1.0, "bare_probability": 1.0})
    assert len(grown(config).gaussians) == 0


def test_colours_are_restored_over_the_range_that_the_config_names() -> None:
    z, shown_z = torch.tensor([2.0, 2.0]), torch.tensor([3.0, 3.0])
    covered = torch.tensor([True, False])
    found = {
        name: colour_range(z, shown_z, covered, InsertionConfig.model_validate(keys)).tolist()
        for name, keys in {
            "tracked": {},
            "rendered": {"colour_range": "rendered"},
        }.items()
    }
    assert found == {"tracked": [2.0, 2.0], "rendered": [3.0, 2.0]}


def test_new_gaussians_stay_at_the_tracked_range_with_other_colours() -> None:
    """The map lies at 2 m, tracking says 4 m: what is seen there was dimmed by more water."""
    born = {}
    for name in ("tracked", "rendered"):
        config = settings(
            insertion={"bare_probability": 1.0, "colour_range": name},
            medium={"initial_attenuation": 0.3, "initial_B_inf": 0.01},
        )
        mapper = Mapper(config, renderer(), 0)
        mapper.scene.gaussians.append(floor())
        mapper.optimiser.extend(len(mapper.gaussians), None)
        before = len(mapper.gaussians)
        count = mapper.insert(view_of(picture(floor(), path(1)[0])), flat_pointmap(4.0))
        assert count > 0
        born[name] = (mapper.gaussians.means[before:, 2], mapper.gaussians.colours[before:].mean())
    for place, _ in born.values():
        torch.testing.assert_close(place, torch.full_like(place, 4.0))
    assert born["tracked"][1] > 1.2 * born["rendered"][1]
