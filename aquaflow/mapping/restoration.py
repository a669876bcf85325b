"""A view's picture without its water."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree
from torch import Tensor

from aquaflow.mapping.scene import RenderedMap, Scene, orientations
from aquaflow.render.transfers import map_out, picture_out, water_in
from aquaflow.render.views import View
from aquaflow.render.water import MIN_SOLID
from aquaflow.water.medium import MIN_TRANSMISSION, WaterParameters
from aquaflow.water.sightings import SOLID
from aquaflow.water.tone import ShownTone
from aquaflow.water.white_balance import Recovered

EDGE_PX = 3.0
"""Deviation of the Gaussian over which open water begins."""
CHUNK = 1 << 18
"""Gaussians whose colours are restored at a time: 150 MB."""
RESTORED = 0.5
"""Confidence above which a pixel's colour is more the picture's than the scene's mean: open water
and what is lost in it say nothing of how light a scene is."""


@dataclass(frozen=True)
class RestoredPicture:
    """One view without its water."""

    image: Tensor
    """[H, W, 3]"""
    confidence: Tensor
    """[H, W] in [0, 1], the share of the colour that was restored from the picture; 0 where nothing
    was: in open water, where the vehicle is, and where nothing was mapped."""
    opaque: Tensor | None
    """[H, W] bool, False where open water was removed; None where it stays in the picture."""
    amplification: Tensor | None
    """[2, 3] RGB, mean over what was restored: as applied, and the most that the posterior allows
    (see water/white_balance.py); None where nothing was, or without a posterior."""

    def picture_bytes(self, tone: ShownTone) -> npt.NDArray[np.uint8]:
        """[H, W, 3], or [H, W, 4] with alpha where open water was removed."""
        colours = to_bytes(tone.of(picture_out(self.image)))
        if self.opaque is None:
            return colours
        return np.dstack([colours, to_bytes(picture_out(self.opaque).astype(np.float32))])

    def confidence_bytes(self) -> npt.NDArray[np.uint8]:
        """[H, W], 255 is 1."""
        return to_bytes(picture_out(self.confidence))


@torch.no_grad()
def restored_picture(scene: Scene, view: View, shown: RenderedMap) -> RestoredPicture:
    """The picture without water, at the ranges that the map ``shown`` from the view has, in the
    white balance that was chosen (see water/white_balance.py).

    Where the vehicle is in the picture, the map's own radiance, bounded alike. J-hat keeps the
    detail that the map has lost: on synthetic dives it is 5 dB closer to the clean scene than the
    map's radiance everywhere. What was not mapped stays as the camera saw it. Open water is black,
    as what was removed ends nowhere; or as the camera saw it; or black with alpha 0
    (``medium.open_water``).
    """
    camera, solid = scene.evenly_lit(view), shown.alpha > SOLID
    recovered = scene.recover(view, camera, shown.z)
    open_water = scene.open_water(view, camera, shown)
    usable = solid & view.scene_mask()
    image = torch.where(usable[..., None], recovered.picture, _own_colours(scene, view, shown))
    image = image + ((1.0 - shown.alpha) * ~usable)[..., None] * camera
    usable = usable & ~open_water
    amplification = None
    if recovered.amplification is not None and recovered.allowed is not None and usable.any():
        applied, allowed = recovered.amplification[usable], recovered.allowed[usable]
        amplification = torch.stack([applied.mean(dim=0), allowed.mean(dim=0)])
    confidence = torch.where(usable, recovered.confidence, 0.0)
    choice, opaque = scene.config.open_water, None
    if choice == "removed":
        image, opaque = image * ~open_water[..., None], ~open_water
    elif bool(open_water.any()):
        share = _with_soft_edge(open_water)[..., None]
        image = image * (1.0 - share) + (share * camera if choice == "kept" else 0.0)
    return RestoredPicture(image, confidence, opaque, amplification)


def _with_soft_edge(
    area: Tensor,  # [H, W] bool
) -> Tensor:
    """[H, W] 1 inside, falling to 0 over a few pixels."""
    share = cv2.GaussianBlur(picture_out(area).astype(np.float32), (0, 0), EDGE_PX)
    return water_in(np.asarray(share, np.float32), area.device)


@torch.no_grad()
def drawn_without_water(scene: Scene, view: View, shown: RenderedMap) -> RestoredPicture:
    """The map's own radiance from the view in place of a picture, as bounded as one; nothing of it
    was restored from one."""
    solid, image = shown.alpha > SOLID, _own_colours(scene, view, shown)
    opaque = None
    if scene.config.open_water == "removed":
        image, opaque = image * solid[..., None], solid
    return RestoredPicture(image, torch.zeros_like(shown.alpha), opaque, None)


def _own_colours(scene: Scene, view: View, shown: RenderedMap) -> Tensor:
    """[H, W, 3] the map's radiance without the view's water, premultiplied by alpha."""
    if scene.water(view) is None:
        return shown.radiance
    alpha = shown.alpha.clamp_min(MIN_SOLID)[..., None]
    return restored_own(scene, view, shown).picture * alpha


def restored_own(scene: Scene, view: View, shown: RenderedMap) -> Recovered:
    """The map's radiance without the view's water, and how far it can be relied on."""
    alpha = shown.alpha.clamp_min(MIN_SOLID)[..., None]
    return restored_radiance(scene, shown.radiance / alpha, shown.z, scene.water(view))


def was_restored(view: View, shown: RenderedMap, own: Recovered) -> Tensor:
    """[H, W] bool, where ``own``, the map from the view without its water, is of something solid in
    the scene, and was restored rather than filled in."""
    return (shown.alpha > SOLID) & view.scene_mask() & (own.confidence > RESTORED)


def to_bytes(
    image: npt.NDArray[np.floating],  # [...] in [0, 1]
) -> npt.NDArray[np.uint8]:
    """[...] as 8-bit."""
    return np.asarray(np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


# --------------------------------------------------------------------------------------------------
# The map's own colours without water, bounded as those of restored pictures are.
#
# The map's radiance J was found behind its water so that pictures fit; where little light came back
# it is as uncertain as that light. So it is put behind the water again, at the range from which it
# was seen, and recovered as a picture is (water/white_balance.py): no channel is amplified beyond
# what its light there allows. Restored frames, PLY files, the viewer, orthos and meshes show this.


@torch.no_grad()
def restored_radiance(
    scene: Scene,
    radiance: Tensor,  # [..., 3] J
    z: Tensor,  # [...] range from which it was seen, map units
    water: WaterParameters | None,
) -> Recovered:
    """J as it is shown without ``water``, in the white balance that was chosen; all of it where
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
        water = scene.waters(orientations(views, scene.device))
        return replace(water, beta_a=water.beta_a.mean(dim=0))


@torch.no_grad()
def restored_gaussians(
    scene: Scene,
    radiance: Tensor,  # [N, 3] of the Gaussians
    views: Sequence[View],
) -> Tensor:
    """[N, 3] colours of the Gaussians without water, each as the nearest of ``views`` saw it."""
    return seen_and_restored(scene, radiance, views)[1].picture


@torch.no_grad()
def seen_and_restored(
    scene: Scene,
    radiance: Tensor,  # [N, 3] of the Gaussians
    views: Sequence[View],
) -> tuple[Tensor, Recovered]:
    """[N, 3] colours of the Gaussians as the nearest of ``views`` saw each, and without water."""
    water = mean_water(scene, views)
    if water is None:
        return radiance, Recovered(radiance, torch.ones_like(radiance[:, 0]))
    tree = KDTree(np.stack([view.T_wc.t for view in views]))
    means = scene.gaussians.means
    parts = [
        _seen_and_restored(scene, radiance[part], means[part], tree, water)
        for part in (slice(first, first + CHUNK) for first in range(0, max(1, len(means)), CHUNK))
    ]
    seen, pictures, confidences = (torch.cat(each) for each in zip(*parts, strict=True))
    return seen, Recovered(pictures, confidences)


def _seen_and_restored(
    scene: Scene,
    radiance: Tensor,  # [N, 3]
    means: Tensor,  # [N, 3]
    cameras: KDTree,
    water: WaterParameters,
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours as the nearest of ``cameras`` saw them, colours without water, and confidence."""
    z = water_in(np.asarray(cameras.query(map_out(means))[0]), radiance.device)
    seen = radiance * water.transmission(z) + water.backscatter(z)
    recovered = restored_radiance(scene, radiance, z, water)
    return seen, recovered.picture, recovered.confidence
