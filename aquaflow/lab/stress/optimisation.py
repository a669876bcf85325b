"""Gaussians gone wrong under optimisation: they cost a step or themselves, not the map."""

from __future__ import annotations

import numpy as np
import torch

from aquaflow.config import MappingConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.stress.case import Check, case
from aquaflow.lab.stress.gaussians import CAMERA, COUNT, cloud
from aquaflow.mapping.mapper import Mapper
from aquaflow.render import select_renderer
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.views import View, refine_pose


@case("gaussians", "render.adam.sound_rows")
def gradients_that_are_not_finite(check: Check, seed: int) -> None:
    """Rows with NaN, infinite and overflowing gradients are skipped, the others move."""
    before = torch.rand(6, 3, generator=torch.Generator().manual_seed(seed))
    tensor = before.clone()
    optimiser = SelectiveAdam({"means": (tensor, 1e-2)}, threads=1)
    gradient = torch.ones(6, 3)
    gradient[0, 0], gradient[1, 1], gradient[2, 2] = float("nan"), float("inf"), 1e30
    optimiser.step(torch.ones(6, dtype=torch.bool), {"means": gradient})
    check.finite("parameters", tensor, *optimiser.second_moments.values())
    check.true("three rows are skipped", optimiser.skipped == 3)
    check.true("skipped rows stay", bool((tensor[:3] == before[:3]).all()))
    check.true("sound rows move", bool((tensor[3:] != before[3:]).all()))


def soaked_map(seed: int, settings: MappingConfig) -> Mapper:
    """A map of ``COUNT`` Gaussians and three views of noise."""
    mapper = Mapper(settings, select_renderer("auto", 1), seed)
    sound = cloud(seed)
    new = {
        "means": sound.means,
        "quats": sound.quats,
        "log_scales": sound.scales.log(),
        "opacity_logits": torch.logit(sound.opacities)[:, None],
        "raw_colours": sound.colours[:, :3],
    }
    mapper.gaussians.extend({name: tensor.contiguous() for name, tensor in new.items()}, 0)
    mapper.optimiser.adam.extend(COUNT)
    mapper.optimiser.adam.bind(mapper.gaussians.parameters)
    rng = np.random.default_rng(seed)
    for i in range(3):
        image = rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
        T_wc = Sim3(np.eye(3), np.array([0.02 * i, 0.0, 0.0]))
        mapper.add_view(View(i, image, CAMERA, T_wc, keyframe=0, robust=False))
    return mapper


def _mapper(seed: int) -> tuple[Mapper, View]:
    """The same map with only its first view, without water."""
    settings = MappingConfig.model_validate({"medium": {"enabled": False}})
    mapper = soaked_map(seed, settings)
    del mapper.views[1:]
    return mapper, mapper.views[0]


@case("gaussians", "mapping.optimisation.is_number")
def nan_in_range_input(check: Check, seed: int) -> None:
    """A range that is no number costs the step: the map stays, and the step is counted."""
    mapper, view = _mapper(seed)
    view.inverse_range = torch.full((CAMERA.height, CAMERA.width), 0.5)
    view.inverse_range[3, 4] = float("nan")
    view.range_confidence = torch.ones(CAMERA.height, CAMERA.width)
    mapper.optimise(3)
    check.true("the steps are undone and counted", mapper.undone == 3)
    check.true("no Gaussian is lost", len(mapper.gaussians) == COUNT)
    check.finite("map", *mapper.gaussians.parameters.values())


@case("gaussians", "mapping.optimisation.MapOptimiser.drop_unsound")
def nan_in_the_map(check: Check, seed: int) -> None:
    """One invalid Gaussian is dropped and does not stop the optimisation."""
    mapper, _ = _mapper(seed)
    mapper.gaussians.parameters["log_scales"][5, 1] = float("nan")
    mapper.gaussians.parameters["log_scales"][7] = 100.0
    mapper.optimise(4)
    check.true("the others are optimised", mapper.steps >= 2)
    check.true("only what is unsound is dropped", COUNT - 2 <= len(mapper.gaussians) < COUNT)
    check.finite("map", *mapper.gaussians.parameters.values())


@case("gaussians", "render.views.is_usable")
def nan_in_pose_gradient(check: Check, seed: int) -> None:
    """A pose gradient that is no number leaves the pose alone."""
    view = _mapper(seed)[1]
    gradient = torch.ones(4, 4)
    gradient[1, 2] = float("nan")
    refine_pose(view, gradient, rate=1e-3)
    check.pose("pose", view.T_wc)
    refine_pose(view, torch.ones(4, 4), rate=1e-3)
    check.pose("pose after a sound step", view.T_wc)
