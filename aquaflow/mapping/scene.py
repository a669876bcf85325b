"""What is mapped: Gaussians, the water in front of them, and the shading of the camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import KDTree
from torch import Tensor

from aquaflow.config import MediumConfig, SunlightConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.gaussians import GaussianMap
from aquaflow.mapping.neural.neural import NeuralGaussians
from aquaflow.mapping.spatial_index import SpatialIndex
from aquaflow.render.contract import Renderer, activate
from aquaflow.render.transfers import (
    map_out,
    picture_out,
    pose_in,
    rows_in,
    water_in,
    water_out,
    weights_in,
)
from aquaflow.render.views import View
from aquaflow.render.water import MIN_SOLID, compose_water
from aquaflow.water.exposure import gain_of, learn_gain
from aquaflow.water.medium import LearnedMedium, WaterParameters
from aquaflow.water.model import TERMS, gain_map
from aquaflow.water.mounting import Lamp
from aquaflow.water.nearest import Nearest
from aquaflow.water.open_sightings import light_of_ground, open_water
from aquaflow.water.sightings import SOLID
from aquaflow.water.sunlight import Sunlight
from aquaflow.water.white_balance import Recovered, WhiteBalance


class Scene:
    """One sub-map's contents; draws them, and fits the water to what the views saw."""

    def __init__(
        self,
        config: MediumConfig,
        renderer: Renderer,
        generator: torch.Generator,
        sunlight: SunlightConfig | None = None,
    ) -> None:
        self.config, self.renderer, self.device = config, renderer, renderer.device
        self.gaussians = GaussianMap(device=self.device)
        self.neural: NeuralGaussians | None = None
        """What is added to the Gaussians by where they are seen from; None: nothing is."""
        self.medium = weights_in(LearnedMedium(config, generator), self.device)
        self.shading = np.zeros(TERMS)
        """Coefficients of the log-gain over the picture."""
        self.lamp: Lamp | None = None
        """Light from beside the camera; None where the last fit found none."""
        self.exposes = False
        """True once the observations showed that some views are brighter than others."""
        self.sunlight = Sunlight(sunlight or SunlightConfig())
        self.water_evidence: float | None = None
        """Log odds of water against clear water or none; None before the first fit."""
        self.beta_a_sigma: list[float] | None = None
        """Relative standard deviation of beta_a in the last fit; None before it."""
        self.balance: WhiteBalance | None = None
        """What restored pictures are shown in; None before the first fit, and without water."""
        self.seen_nearest: tuple[Nearest, list[View]] | None = None
        """What the views of the last fit showed nearest."""
        self.range_variance: tuple[float, float] | None = None
        """Of the points' colours in the last fit, with the water and without; None before it."""
        self.lightness_over_range: tuple[float, float] | None = None
        """Of the same ground in the last fit, far over near, with the water and without; None where
        too little was seen from both."""
        self.gain_maps: dict[tuple[str, int, int], Tensor | None] = {}
        self._finished = False
        self._index: SpatialIndex | None = None
        """Of a finished map; made when a view is first drawn."""

    def water(self, view: View) -> WaterParameters | None:
        """The medium for this view, or None while it is switched off."""
        if not self.medium.active:
            return None
        return self.waters(orientations([view], self.device)[0])

    def waters(
        self,
        R_wc: Tensor,  # [3, 3] or [V, 3, 3] camera to world
    ) -> WaterParameters:
        """The medium, and the lamp, of cameras with this orientation."""
        water: WaterParameters = self.medium(R_wc)
        return replace(water, lamp=self.lamp)

    @torch.no_grad()
    def use_unit_and_light(
        self,
        scale: float,
        gain: Tensor,  # [3]
    ) -> None:
        """Let the water be that of a map in which a length of one is ``scale`` and radiances are
        ``gain`` times as large, before views whose exposures are as much smaller."""
        self.medium.use_unit_and_light(scale, gain)
        if self.lamp is not None:
            self.lamp = self.lamp.rescale(scale)
        if self.balance is not None:
            mean = tuple((water_out(gain) * self.balance.mean).tolist())
            near_range = scale * self.balance.near_range
            self.balance = replace(self.balance, near_range=near_range, mean=mean)
        if self.seen_nearest is not None:
            near, views = self.seen_nearest
            self.seen_nearest = replace(near, z=scale * near.z), views
        self.exposes = self.exposes or bool((gain != 1.0).any())

    def centre_water(self, views: Sequence[View]) -> None:
        """Let the attenuation of ``views`` be on the mean that which the water fit found."""
        if self.medium.directional:
            self.medium.centre(orientations(views, self.device))

    def gain(self, view: View) -> Tensor | None:
        """The shading [H, W] of this view's pictures; None where there is none."""
        return self._gain_map("shading", lambda: self.shading, view) if self.shading.any() else None

    def uneven(self, view: View) -> Tensor | None:
        """The gain [H, W] of the backscatter in this view's pictures; None where it is even."""
        if not self.medium.active:
            return None
        return self._gain_map("uneven", self.unevenness, view)

    def unevenness(self) -> npt.NDArray[np.float64]:
        """[5] coefficients of the backscatter's log-gain over the picture."""
        return water_out(self.medium.unevenness)

    def _gain_map(
        self,
        name: str,
        coefficients: Callable[[], npt.NDArray[np.float64]],  # [5]
        view: View,
    ) -> Tensor | None:
        key = (name, view.camera.height, view.camera.width)
        if key not in self.gain_maps:
            found = coefficients()
            is_even = not found.any()
            gains = None if is_even else water_in(gain_map(found, *key[1:]), self.device)
            self.gain_maps[key] = gains
        return self.gain_maps[key]

    def draw(
        self,
        view: View,
        parameters: Mapping[str, Tensor] | None = None,  # of a GaussianMap
        viewmat: Tensor | None = None,  # [4, 4]
        learn: bool = False,
        active: Tensor | None = None,  # [rows, columns] bool, the tiles to draw
    ) -> RenderedMap:
        """The scene from ``view``; differentiable in what is given.

        ``parameters`` are decoded ones, where there is a decoder. With ``learn`` it is
        differentiable in the medium too (where that is directional: in any case), and the view's
        exposure and its light are set from its picture in passing.
        """
        viewmat = view.viewmat() if viewmat is None else viewmat
        if parameters is None:
            parameters = self.in_sight(view, viewmat)
        water_learns = learn or self.medium.directional  # no fit finds what orientation does
        with torch.set_grad_enabled(water_learns and torch.is_grad_enabled()):
            water = self.water(view)
        gain, uneven = self.gain(view), self.uneven(view)
        shown = show(parameters, water, gain, self.renderer, view, viewmat, active, uneven)
        if learn:
            self.learn_light(view, shown.image.detach(), shown.alpha)
        light = self.sunlight.over(view, self.exposure(view))
        return shown if light is None else replace(shown, image=shown.image * light)

    def exposure(self, view: View) -> Tensor | None:
        """The gain [3] of the exposure of ``view``; None where all views have the same."""
        return gain_of(view) if self.exposes else None

    @property
    def learns_light(self) -> bool:
        """Whether :meth:`learn_light` learns anything."""
        return self.exposes or self.sunlight.config.enabled

    def learn_light(
        self,
        view: View,
        image: Tensor,  # [H, W, 3] the map from this view, in even light
        alpha: Tensor,  # [H, W]
    ) -> None:
        """Set the view's exposure and its light from its picture."""
        if self.exposes:
            learn_gain(view, image, alpha)
        self.sunlight.learn(view, image, alpha, self.exposure(view))

    def seen_from(
        self,
        view: View,
        viewmat: Tensor,  # [4, 4]
    ) -> Mapping[str, Tensor]:
        """The Gaussians' parameters as ``view`` sees them; no gradient."""
        if self.neural is None:
            return self.gaussians.parameters
        return self.neural.seen_from(view, viewmat)

    def in_sight(
        self,
        view: View,
        viewmat: Tensor,  # [4, 4] of ``view``
    ) -> Mapping[str, Tensor]:
        """As :meth:`seen_from`; of a finished map only those Gaussians that ``view`` may show, in
        their order, which make the same picture."""
        rows = None if self.neural is not None else self.near(view.camera, view.T_wc)
        if rows is None:
            return self.seen_from(view, viewmat)
        return {
            name: each.index_select(0, rows) for name, each in self.gaussians.parameters.items()
        }

    def near(self, camera: CameraModel, T_wc: Sim3) -> Tensor | None:
        """[M] numbers, ascending, of the Gaussians that a picture from there may show; None for all
        of them, as of a map that is not finished."""
        if not self._finished:
            return None
        if self._index is None:
            largest = self.gaussians.parameters["log_scales"].amax(dim=1).exp()
            self._index = SpatialIndex(map_out(self.gaussians.means), map_out(largest))
        rows = self._index.in_picture(camera, T_wc)
        return None if len(rows) == len(self.gaussians) else rows_in(rows, self.device)

    def finish(self) -> None:
        """Nothing changes the Gaussians from here on, until :meth:`go_on`: so their places are
        kept in an index."""
        self._finished = True

    def go_on(self) -> None:
        """The Gaussians may change again."""
        self._finished, self._index = False, None

    def bake_parameters(self, views: list[View]) -> Mapping[str, Tensor]:
        """The parameters as plain Gaussians, each as seen from the nearest of ``views``."""
        if self.neural is None or not views:
            return self.gaussians.parameters
        return self.neural.bake_parameters(self.nearest_cameras(views)[0])

    @torch.no_grad()
    def bake(self, views: list[View]) -> Tensor:
        """Let the Gaussians themselves be as :meth:`baked`; the decoder no longer fits them.

        Returns the centres [N, 3] that they were seen from.
        """
        if not views:
            self.neural = None
            return torch.zeros_like(self.gaussians.means)
        centres = self.nearest_cameras(views)[0]
        if self.neural is not None:
            baked = self.neural.bake_parameters(centres)
            for name, tensor in self.gaussians.parameters.items():
                tensor.copy_(baked[name])
            self.neural = None
        return centres

    def nearest_cameras(self, views: Sequence[View]) -> tuple[Tensor, Tensor, Tensor]:
        """Place of the camera nearest to each Gaussian: centre [N, 3], distance [N], number [N]."""
        centres = np.stack([view.T_wc.t for view in views])
        z, which = KDTree(centres).query(map_out(self.gaussians.means))
        return (
            pose_in(centres[which], self.device), pose_in(np.asarray(z), self.device),
            rows_in(np.asarray(which, np.int64), self.device),
        )  # fmt: skip

    @contextmanager
    def learning_from(self, views: Sequence[View]) -> Iterator[None]:
        """Steps on ``views`` in their order; what they say of features is applied by the end."""
        if self.neural is not None:
            self.neural.expect(views)
        try:
            yield
        finally:
            if self.neural is not None:
                self.neural.settle()

    @torch.no_grad()
    def show(self, view: View, learn: bool = False) -> RenderedMap:
        """The scene from ``view``, for looking."""
        return self.draw(view, learn=learn)

    @torch.no_grad()
    def restore(
        self,
        view: View,
        z: Tensor,  # [H, W] range
    ) -> tuple[Tensor, Tensor]:
        """J-hat [H, W, 3] of the view's picture, and where it can be believed [H, W]."""
        image, water = self.evenly_lit(view), self.water(view)
        if water is None:
            return image, torch.ones(image.shape[:2], dtype=torch.bool, device=self.device)
        return water.restore(image, z, self.uneven(view))

    @torch.no_grad()
    def evenly_lit(self, view: View) -> Tensor:
        """[H, W, 3] the view's picture without shading, exposure and playing light."""
        image, gain = view.target(), self.gain(view)
        if gain is not None:
            image = image / gain[..., None]
        light = self.sunlight.over(view, self.exposure(view))
        return image if light is None else image / light

    @torch.no_grad()
    def recover(
        self,
        view: View,
        lit: Tensor,  # [H, W, 3] its picture, evenly lit
        z: Tensor,  # [H, W] range
    ) -> Recovered:
        """The view's picture without water, in the white balance that was chosen.

        Before the first fit there is no posterior: a pixel is believed wholly or not at all.
        """
        water, uneven = self.water(view), self.uneven(view)
        if water is None:
            return Recovered(lit, torch.ones_like(z))
        if self.balance is not None:
            return self.balance.recover(lit, z, water, uneven)
        picture, recoverable = water.restore(lit, z, uneven)
        return Recovered(picture, recoverable.to(picture.dtype))

    @torch.no_grad()
    def open_water(
        self,
        view: View,
        lit: Tensor,  # [H, W, 3] its picture, evenly lit
        shown: RenderedMap,
    ) -> Tensor:
        """[H, W] bool, True where the view's picture shows nothing but water; nowhere before the
        first fit, which says what ground would return."""
        water = self.water(view)
        if water is None or self.balance is None:
            return torch.zeros(lit.shape[:2], dtype=torch.bool, device=self.device)
        uneven = self.uneven(view)
        B_inf = water.B_inf.expand(lit.shape)
        B_inf = B_inf if uneven is None else B_inf * uneven[..., None]
        T = picture_out(water.transmission(shown.z))
        ground = light_of_ground(np.array(self.balance.mean), T, picture_out(shown.alpha > SOLID))
        found = open_water(picture_out(lit), picture_out(B_inf.contiguous()), ground)
        return water_in(found, self.device, torch.bool) & view.scene_mask()

    @torch.no_grad()
    def apply_white_balance(
        self,
        radiance: Tensor,  # [..., 3] J
    ) -> Tensor:
        """[..., 3] J in the white balance that was chosen."""
        return radiance * self.white_gain()

    @torch.no_grad()
    def white_gain(self) -> Tensor:
        """[3] of J, by which it has the white balance that was chosen."""
        if not self.medium.active or self.balance is None:
            return torch.ones(3, device=self.device)
        return water_in(self.balance.white, self.device)


def orientations(views: Sequence[View], device: torch.device) -> Tensor:
    """[V, 3, 3] camera to world."""
    rotations = np.array([view.T_wc.R for view in views], np.float32).reshape(-1, 3, 3)
    return pose_in(rotations, device)


# --------------------------------------------------------------------------------------------------
# One picture of the map: clean radiance and range from the renderer, then the water.


@dataclass(frozen=True)
class RenderedMap:
    """The map from one view."""

    image: Tensor
    """[H, W, 3] I-hat, through the water and with the camera's shading."""
    radiance: Tensor
    """[H, W, 3] J-tilde, without water, premultiplied by alpha."""
    alpha: Tensor
    """[H, W]"""
    z: Tensor
    """[H, W] range along the ray, map units; meaningless where alpha is near 0."""
    visible: Tensor
    """[N] bool, of the Gaussians that were drawn: of a finished map those near the view."""
    radius_px: Tensor
    """[N]"""
    active: Tensor | None = None
    """[rows, columns] bool, the tiles that were drawn; None: all."""


def show(
    parameters: Mapping[str, Tensor],  # of a GaussianMap
    water: WaterParameters | None,
    gain: Tensor | None,  # [H, W] shading
    renderer: Renderer,
    view: View,
    viewmat: Tensor,  # [4, 4] world to camera
    active: Tensor | None = None,  # [rows, columns] bool, the tiles to draw
    uneven: Tensor | None = None,  # [H, W] gain of the backscatter
) -> RenderedMap:
    """Draw the map; differentiable in the parameters, the water and the view matrix.

    Range rides as a fourth colour channel divided by alpha, the same on every renderer.
    """
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
    activated = activate(
        parameters["means"],
        parameters["log_scales"],
        parameters["opacity_logits"],
        parameters["raw_colours"],
        centre,
        renderer.threads,
    )
    drawn = renderer(
        parameters["means"],
        parameters["quats"],
        *activated,
        viewmat,
        view.K(),
        view.camera.width,
        view.camera.height,
        active,
    )
    clean, seen = drawn.image[..., :3], drawn.image
    if water is not None and water.lamp is not None:
        z = seen[..., 3].detach() / drawn.alpha.detach().clamp_min(MIN_SOLID)
        seen = torch.cat([clean * water.light(water.lamp, z), seen[..., 3:]], dim=-1)
    if water is None:
        z = drawn.image[..., 3] / drawn.alpha.clamp_min(MIN_SOLID)
        image = clean if gain is None else clean * gain[..., None]
    else:
        image, z = compose_water(seen, drawn.alpha, water.stack(), renderer.threads, uneven, gain)
    return RenderedMap(image, clean, drawn.alpha, z, drawn.visible, drawn.radius_px, active)
