"""How Gaussians look to the views that see them, which holds while the water in front changes.

A Gaussian's radiance J is known through the water alone: a view at range z sees
``gain (J T(z) + B(z))`` (paper, Eq. 12). Where the water or a view's exposure is found anew, where
a map is absorbed by one with other water, and where Gaussians come back into memory after such
changes, they get the radiance that looks the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from aquaflow.geometry.arrays import Arrays
from aquaflow.mapping.gaussians import GaussianMap, raw_colour
from aquaflow.mapping.scene import Scene, orientations
from aquaflow.render.contract import radiance
from aquaflow.render.transfers import pose_in
from aquaflow.render.views import View
from aquaflow.water.exposure import gain_of
from aquaflow.water.medium import MAX_RESTORED, MIN_TRANSMISSION, WaterParameters


@dataclass(frozen=True)
class Looks:
    """What points look like through the water to their views: ``factor J + veil``."""

    factor: Tensor
    """[N, 3]"""
    veil: Tensor
    """[N, 3]"""


@torch.no_grad()
def looks(
    scene: Scene,
    views: Sequence[View],
    which: Tensor,  # [N] int64, the view of each point
    z: Tensor,  # [N] range from there
) -> Looks:
    """At the exposures of the views; what differs within a picture is left out."""
    gain = torch.ones(len(z), 3, device=scene.device)
    if scene.exposes:
        gain = torch.stack([gain_of(view) for view in views])[which]
    if not scene.medium.active:
        return Looks(gain, torch.zeros_like(gain))
    water = water_of(scene, views, which)
    return Looks(gain * water.transmission(z), gain * water.backscatter(z))


def water_of(
    scene: Scene,
    views: Sequence[View],
    which: Tensor,  # [N] int64
) -> WaterParameters:
    """The water for N points, each seen from its own view: beta_a is [N, 3]."""
    water = scene.waters(orientations(views, scene.device))
    return replace(water, beta_a=water.beta_a[which])


def recoloured(
    raw: Tensor,  # [N, 3] colours of Gaussians
    before: Looks,
    after: Looks,
) -> Tensor:
    """[N, 3] that look ``after`` a change as ``raw`` did ``before``, as far as enough light arrives
    to tell; bit for bit ``raw`` where nothing has changed."""
    J = radiance(raw)
    change = J * (before.factor - after.factor) + (before.veil - after.veil)
    new = J + change / after.factor.clamp_min(MIN_TRANSMISSION)
    brightest = J.clamp_min(MAX_RESTORED)
    return torch.where(change == 0.0, raw, raw_colour(torch.minimum(new, brightest)))


def absorbed_colours(
    scene: Scene,
    other: Scene,
    views: Sequence[View],  # of the other
) -> Tensor:
    """[N, 3] raw colours with which the other's Gaussians look to its ``views`` in the water of
    ``scene`` as they do in its own."""
    raw = other.gaussians.parameters["raw_colours"]
    if len(raw) == 0 or not views:
        return raw
    _, z, which = other.nearest_cameras(views)
    return recoloured(raw, looks(other, views, which, z), looks(scene, views, which, z))


# --- while Gaussians wait in files ----------------------------------------------------------------


@torch.no_grad()
def kept_looks(
    scene: Scene,
    views: Sequence[View],  # of the map
) -> dict[str, Tensor]:
    """What to keep of Gaussians that leave memory: their range [N] from the first view of their
    keyframe, and how they look to it."""
    gaussians = scene.gaussians
    first, which = _first_views(views, gaussians.keyframes)
    centres = pose_in(np.array([view.T_wc.t for view in first]).reshape(-1, 3), scene.device)
    z = (gaussians.means - centres[which]).norm(dim=1)
    return {"z": z, **vars(looks(scene, first, which, z))}


@torch.no_grad()
def follow_water(
    scene: Scene,
    views: Sequence[View],  # of the map
    gaussians: GaussianMap,
    kept: Sequence[Arrays],  # by tile, in their order, as from kept_looks; z in the unit of now
) -> None:
    """Let the Gaussians of tiles that come back look as they did when they left."""
    parts = [each for each in kept if "veil" in each]  # not in files written before 2026-11-29
    if not parts:
        return
    known = np.repeat(["veil" in each for each in kept], [len(each["steps"]) for each in kept])
    rows = torch.from_numpy(np.flatnonzero(known))
    z, factor, veil = (
        torch.from_numpy(np.concatenate([each[name] for each in parts]))
        for name in ("z", "factor", "veil")
    )
    raw = gaussians.parameters["raw_colours"]
    now = looks(scene, *_first_views(views, gaussians.keyframes[rows]), z)
    raw[rows] = recoloured(raw[rows], Looks(factor, veil), now)


def _first_views(
    views: Sequence[View],
    keyframes: Tensor,  # [N]
) -> tuple[list[View], Tensor]:
    """The first view of each of these keyframes, or of the nearest that has one; which [N]."""
    numbers, which = torch.unique(keyframes, return_inverse=True)
    first = dict[int, View]()
    for view in views:
        first.setdefault(view.keyframe, view)
    known = np.array(sorted(first))
    nearest = np.searchsorted((known[1:] + known[:-1]) / 2.0, numbers.numpy())
    return [first[number] for number in known[nearest].tolist()], which
