"""The water of a map on a device: fitted, learned in passing, and taken out of pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from aquaflow.mapping.restoration import restored_picture
from aquaflow.mapping.scene import Scene
from aquaflow.mapping.scene_water import rebalance
from aquaflow.render.transfers import insertion_in
from aquaflow.water.tone import ShownTone
from tests.device.device_scenes import WHERE, SinglePrecision
from tests.mapping.mapping_scenes import fit_water
from tests.mapping.water_scenes import in_clear_water, submerged

pytestmark = pytest.mark.usefixtures("nothing_strays")


def fitted(where: torch.device, dimmed: bool) -> tuple[Scene, list[Any]]:
    """A scene whose water and exposures were fitted, and one of its views without water."""
    seen = submerged() if not dimmed else in_clear_water(dimmed_from=3)
    floating, views = seen
    scene = Scene(floating.config, SinglePrecision(where), torch.Generator().manual_seed(0))
    for name, tensor in floating.gaussians.parameters.items():
        scene.gaussians.parameters[name] = insertion_in(tensor, where)
    scene.gaussians.keyframes = insertion_in(floating.gaussians.keyframes, where)
    for view in views:
        view.begin_on(where)
    assert fit_water(scene, views, torch.Generator().manual_seed(0)) is not None
    rebalance(scene)
    restored = restored_picture(scene, views[0], scene.show(views[0]))
    return scene, [restored.picture_bytes(ShownTone(0.9)), restored.confidence_bytes()]


@pytest.mark.parametrize("dimmed", [False, True])
def test_the_water_fitted_to_a_map_on_a_device_is_that_of_the_cpu(dimmed: bool) -> None:
    (wanted, pictures), (got, got_pictures) = (fitted(where, dimmed) for where in WHERE)
    assert got.exposes == wanted.exposes == dimmed
    assert got.medium.active == wanted.medium.active != dimmed
    for name, tensor in wanted.medium.state_dict().items():
        torch.testing.assert_close(got.medium.state_dict()[name].cpu(), tensor, msg=name)
    raw = (scene.gaussians.parameters["raw_colours"].cpu() for scene in (got, wanted))
    torch.testing.assert_close(*raw, atol=1e-4, rtol=1e-4)
    for restored, expected in zip(got_pictures, pictures, strict=True):
        np.testing.assert_allclose(restored.astype(int), expected.astype(int), atol=1)
