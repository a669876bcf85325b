"""Pose of a view that was never mapped, against the frozen map."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from aquaflow.config import OptimiserConfig
from aquaflow.mapping.optimisation.objective import Objective
from aquaflow.mapping.scene import Scene
from aquaflow.mapping.views import View, refine_pose
from aquaflow.mapping.water.exposure import log_gain_at, set_log_gain
from aquaflow.mapping.water.sunlight import light_at


def register(
    view: View,
    scene: Scene,
    mapped: Sequence[View],  # in the order of their frames
    objective: Objective,
    config: OptimiserConfig,
) -> None:
    """Refine the pose of ``view`` photometrically.

    Its exposure and its light are those of its neighbours in time: nothing of them is learned from
    its own picture (the peers do so for exposure).
    """
    if mapped:
        set_log_gain(view, log_gain_at(view.frame_index, mapped))
        view.light = light_at(view.frame_index, mapped)
    for _ in range(config.heldout_steps if len(scene.gaussians) else 0):
        viewmat = view.viewmat().requires_grad_()
        loss = objective.photometric(view, scene.draw(view, viewmat=viewmat))
        (gradient,) = torch.autograd.grad(loss, viewmat)
        refine_pose(view, gradient, config.heldout_rate)
