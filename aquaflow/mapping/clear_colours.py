"""The map's own colours without water, bounded as those of restored pictures are.

The map's radiance J was found behind its water so that pictures fit; where little light came back
it is as uncertain as that light. So it is put behind the water again, at the range from which it
was seen, and recovered as a picture is (water/white_balance.py): no channel is amplified beyond
what its light there allows. Restored frames, PLY files, the viewer, orthos and meshes show this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from aquaflow.mapping.scene import Scene, orientations
from aquaflow.render.transfers import map_out, water_in
from aquaflow.render.views import View
from aquaflow.water.image_formation import MIN_TRANSMISSION, WaterParameters
from aquaflow.water.white_balance import Recovered


@torch.no_grad()
def restored_radiance(
    scene: Scene,
    radiance: Tensor,  # [..., 3] J
    z: Tensor,  # [...] range from which it was seen, map units
    water: WaterParameters | None,
) -> Recovered:
    """J as it is shown without ``water``, in the white balance of what is nearest; all of it where
    there is no water."""
    if water is None:
        return Recovered(radiance, torch.ones_like(z))
    T = water.transmission(z)
    if scene.balance is None:
        # Before the first fit, as Water.restore has it.
        weakest = (T > MIN_TRANSMISSION).all(dim=-1)
        return Recovered(radiance * (T / MIN_TRANSMISSION).clamp_max(1.0), weakest.to(T.dtype))
    return scene.balance.recover(radiance * T + water.backscatter(z), z, water)


def mean_water(scene: Scene, views: Sequence[View]) -> WaterParameters | None:
    """The water of the mean of ``views``; None where there is none."""
    if not scene.medium.active or not views:
        return None
    with torch.no_grad():
        water: WaterParameters = scene.medium(orientations(views, scene.device))
        return replace(water, beta_a=water.beta_a.mean(dim=0))


@torch.no_grad()
def restored_gaussians(
    scene: Scene,
    radiance: Tensor,  # [N, 3] of the Gaussians
    views: Sequence[View],
) -> Tensor:
    """[N, 3] colours of the Gaussians without water, each as the nearest of ``views`` saw it."""
    water = mean_water(scene, views)
    if water is None:
        return radiance
    centres = np.stack([view.T_wc.t for view in views])
    nearest = KDTree(centres).query(map_out(scene.gaussians.means))[0]
    return restored_radiance(
        scene, radiance, water_in(np.asarray(nearest), radiance.device), water
    ).picture
