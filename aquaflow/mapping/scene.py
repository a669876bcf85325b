"""What is mapped: Gaussians, the water in front of them, and the shading of the camera."""

from __future__ import annotations

import copy
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.config import MediumConfig, SunlightConfig
from aquaflow.mapping.decoder.neural import NeuralGaussians
from aquaflow.mapping.gaussians.gaussians import GaussianMap, radiance, raw_colour
from aquaflow.mapping.rendering import Shown, show
from aquaflow.mapping.views import View
from aquaflow.mapping.water.estimation import WaterEstimate, estimating, models_for
from aquaflow.mapping.water.exposure import gain_of, learn_gain, set_log_gains
from aquaflow.mapping.water.image_formation import Water
from aquaflow.mapping.water.medium import Medium
from aquaflow.mapping.water.nearest import Nearest, kept_by
from aquaflow.mapping.water.open_water import open_water
from aquaflow.mapping.water.posed_picture import PosedPicture
from aquaflow.mapping.water.shading import TERMS, gain_map, shading_basis
from aquaflow.mapping.water.sightings import sighting
from aquaflow.mapping.water.sunlight import Sunlight
from aquaflow.mapping.water.white_balance import Recovered, WhiteBalance
from aquaflow.render.contract import Renderer


class Scene:
    """One sub-map's contents; draws them, and fits the water to what the views saw."""

    def __init__(
        self,
        config: MediumConfig,
        renderer: Renderer,
        generator: torch.Generator,
        sunlight: SunlightConfig | None = None,
    ) -> None:
        self.config, self.renderer = config, renderer
        self.gaussians = GaussianMap()
        self.neural: NeuralGaussians | None = None
        """What is added to the Gaussians by where they are seen from; None: nothing is."""
        self.medium = Medium(config, generator)
        self.shading = np.zeros(TERMS)
        """Coefficients of the log-gain over the picture."""
        self.exposes = False
        """True once the observations showed that some views are brighter than others."""
        self.sunlight = Sunlight(sunlight or SunlightConfig())
        self.water_evidence: float | None = None
        """Log odds of water against clear water or none; None before the first fit."""
        self.beta_a_sigma: list[float] | None = None
        """Relative standard deviation of beta_a in the last fit; None before it."""
        self.balance: WhiteBalance | None = None
        """What restored pictures are shown in; None before the first fit, and without water."""
        self._seen_nearest: tuple[Nearest, list[View]] | None = None
        """What the views of the last fit showed nearest."""
        self.range_variance: tuple[float, float] | None = None
        """Of the points' colours in the last fit, with the water and without; None before it."""
        self._gains: dict[tuple[str, int, int], Tensor] = {}

    def water(self, view: View) -> Water | None:
        """The medium for this view, or None while it is switched off."""
        if not self.medium.active:
            return None
        R_wc = torch.from_numpy(view.T_wc.R).to(torch.float32)
        return self.medium(R_wc)  # type: ignore[no-any-return]

    def gain(self, view: View) -> Tensor | None:
        """The shading [H, W] of this view's pictures; None where there is none."""
        return self._gain_map("shading", self.shading, view)

    def uneven(self, view: View) -> Tensor | None:
        """The gain [H, W] of the backscatter in this view's pictures; None where it is even."""
        if not self.medium.active:
            return None
        return self._gain_map("uneven", self.medium.unevenness.double().numpy(), view)

    def _gain_map(
        self,
        name: str,
        coefficients: npt.NDArray[np.float64],  # [5]
        view: View,
    ) -> Tensor | None:
        if not coefficients.any():
            return None
        key = (name, view.camera.height, view.camera.width)
        if key not in self._gains:
            self._gains[key] = torch.from_numpy(gain_map(coefficients, *key[1:]))
        return self._gains[key]

    def draw(
        self,
        view: View,
        parameters: Mapping[str, Tensor] | None = None,  # of a GaussianMap
        viewmat: Tensor | None = None,  # [4, 4]
        learn: bool = False,
        active: Tensor | None = None,  # [rows, columns] bool, the tiles to draw
    ) -> Shown:
        """The scene from ``view``; differentiable in what is given, and in the medium.

        ``parameters`` are decoded ones, where there is a decoder. With ``learn``, the view's
        exposure and its light are set from its picture in passing.
        """
        viewmat = view.viewmat() if viewmat is None else viewmat
        if parameters is None:
            parameters = self.seen_from(view, viewmat)
        water, gain, uneven = self.water(view), self.gain(view), self.uneven(view)
        shown = show(parameters, water, gain, self.renderer, view, viewmat, active, uneven)
        image = shown.image
        if self.exposes:
            if learn:
                learn_gain(view, image, shown.alpha)
            image = image * gain_of(view)
        return replace(shown, image=self.sunlight.shine(view, image, shown.alpha, learn))

    def seen_from(
        self,
        view: View,
        viewmat: Tensor,  # [4, 4]
    ) -> Mapping[str, Tensor]:
        """The Gaussians' parameters as ``view`` sees them; no gradient."""
        if self.neural is None:
            return self.gaussians.parameters
        return self.neural.seen_from(view, viewmat)

    def baked(self, views: list[View]) -> Mapping[str, Tensor]:
        """The parameters as plain Gaussians, each as seen from the nearest of ``views``."""
        if self.neural is None or not views:
            return self.gaussians.parameters
        return self.neural.baked(self._nearest(views)[0])

    @torch.no_grad()
    def bake(self, views: list[View]) -> Tensor:
        """Let the Gaussians themselves be as :meth:`baked`; the decoder no longer fits them.

        Returns the centres [N, 3] that they were seen from.
        """
        if not views:
            self.neural = None
            return torch.zeros_like(self.gaussians.means)
        centres = self._nearest(views)[0]
        if self.neural is not None:
            baked = self.neural.baked(centres)
            for name, tensor in self.gaussians.parameters.items():
                tensor.copy_(baked[name])
            self.neural = None
        return centres

    def _nearest(self, views: Sequence[View]) -> tuple[Tensor, Tensor, Tensor]:
        """Of the camera nearest to each Gaussian: centre [N, 3], distance [N], number [N]."""
        centres = torch.from_numpy(np.stack([view.T_wc.t for view in views])).to(torch.float32)
        z, which = torch.cdist(self.gaussians.means, centres).min(dim=1)
        return centres[which], z, which

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
    def show(self, view: View, learn: bool = False) -> Shown:
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
            return image, torch.ones(image.shape[:2], dtype=torch.bool)
        return water.restore(image, z, self.uneven(view))

    @torch.no_grad()
    def evenly_lit(self, view: View) -> Tensor:
        """[H, W, 3] the view's picture without shading, exposure and playing light."""
        image, gain = view.target(), self.gain(view)
        if gain is not None:
            image = image / gain[..., None]
        if self.exposes:
            image = image / gain_of(view)
        return self.sunlight.evened(view, image)

    @torch.no_grad()
    def recovered(
        self,
        view: View,
        z: Tensor,  # [H, W] range
    ) -> Recovered:
        """The view's picture without water, in the white balance of what is nearest.

        Before the first fit there is no posterior: a pixel is believed wholly or not at all.
        """
        image, water, uneven = self.evenly_lit(view), self.water(view), self.uneven(view)
        if water is None:
            return Recovered(image, torch.ones_like(z))
        if self.balance is not None:
            return self.balance.recover(image, z, water, uneven)
        picture, recoverable = water.restore(image, z, uneven)
        return Recovered(picture, recoverable.to(picture.dtype))

    @torch.no_grad()
    def open_water(self, view: View) -> Tensor:
        """[H, W] bool, True where the view's picture shows nothing but water."""
        image, water = self.evenly_lit(view), self.water(view)
        if water is None:
            return torch.zeros(image.shape[:2], dtype=torch.bool)
        uneven = self.uneven(view)
        B_inf = water.B_inf.expand(image.shape)
        B_inf = B_inf if uneven is None else B_inf * uneven[..., None]
        found = torch.from_numpy(open_water(image.numpy(), B_inf.contiguous().numpy()))
        return found & view.scene_mask()

    @torch.no_grad()
    def balanced(
        self,
        radiance: Tensor,  # [..., 3] J
    ) -> Tensor:
        """[..., 3] J in the white balance of what is nearest."""
        return radiance * self.white_gain()

    @torch.no_grad()
    def white_gain(self) -> Tensor:
        """[3] of J, by which it has the white balance of what is nearest."""
        if not self.medium.active or self.balance is None:
            return torch.ones(3)
        return torch.tensor(self.balance.gain)

    @torch.no_grad()
    def rebalance(self) -> None:
        """After steps that changed medium and exposures: what is nearest keeps its colours."""
        if self.balance is None or self._seen_nearest is None or not self.medium.active:
            return
        near, views = self._seen_nearest
        basis, water = shading_basis(near.xy), self.medium(torch.eye(3))
        log_gain = (basis @ self.shading)[:, None]
        if self.exposes:
            log_gain = log_gain + np.stack([view.log_gain for view in views])[near.view]
        z = torch.from_numpy(near.z).to(torch.float32)
        T, veil = (part.double().numpy() for part in (water.transmission(z), water.backscatter(z)))
        veil = veil * np.exp(basis @ self.medium.unevenness.double().numpy())[:, None]
        clean = np.maximum(near.colour / np.exp(log_gain) - veil, 0.0) / T
        self.balance = replace(self.balance, gain=kept_by(near, clean.T))

    def fitting_water(
        self, views: Sequence[View], generator: torch.Generator
    ) -> Generator[None, None, tuple[WaterEstimate | None, list[View]]]:
        """Estimate water, shading and exposure from what ``views`` saw; the scene stays as it is.

        Pauses every few milliseconds. Returns the estimate, None while too little is seen from
        several ranges, and the views that it was fitted to: those that still have their pixels.
        """
        if not self.config.fit or len(self.gaussians) == 0:
            return None, []
        pictures, fitted = [], []
        for view in views:
            if view.has_pixels:
                shown = self.show(view)
                pictures.append(PosedPicture(view, shown.z, shown.alpha))
                fitted.append(view)
                yield
        if not fitted:
            return None, []
        seed = int(torch.randint(2**31, (1,), generator=generator))
        seen = yield from sighting(pictures, np.random.default_rng(seed))
        yield
        with torch.no_grad():
            sea = self.medium(torch.from_numpy(fitted[0].T_wc.R).to(torch.float32))
        B_res, d = sea.B_res.double().numpy(), sea.d.double().numpy()
        models, priors = models_for(self.config), self.config.priors
        steps = estimating(seen, B_res, d, models, priors, pictures)
        return (yield from steps), fitted

    def adopt_water(
        self, estimate: WaterEstimate, fitted: Sequence[View], dive: Sequence[View]
    ) -> None:
        """Let the estimate hold; the pictures of the map stay as they are.

        All views of the ``dive`` get an exposure.
        """
        with self._unchanged_by_failure():
            self._adopt(estimate, fitted, dive)

    @contextmanager
    def _unchanged_by_failure(self) -> Iterator[None]:
        """The water as it was, if the block raises: half of a new one fits no picture."""
        medium, active = copy.deepcopy(self.medium.state_dict()), self.medium.active
        before = vars(self).copy()
        try:
            yield
        except Exception:
            self.medium.load_state_dict(medium)
            self.medium.active = active
            vars(self).update(before)
            self._gains.clear()
            raise

    @torch.no_grad()
    def _adopt(self, estimate: WaterEstimate, fitted: Sequence[View], dive: Sequence[View]) -> None:
        """Let the estimate hold, and give every Gaussian the radiance that looks the same in it.

        The same from the camera nearest to it: where it is seen best.
        """
        shown, (_, z, nearest) = self.baked(list(fitted))["raw_colours"], self._nearest(fitted)
        old, old_gains = self.water(fitted[0]), torch.stack([gain_of(view) for view in fitted])
        self.medium.active = estimate.model.water
        if estimate.model.water:
            found = (estimate.beta_a, estimate.B_inf, estimate.b, estimate.unevenness)
            self.medium.set_water(*(torch.from_numpy(v).to(torch.float32) for v in found))
        self.shading, self.exposes = estimate.shading, estimate.model.exposure
        self.beta_a_sigma, self.water_evidence = estimate.beta_a_sigma, estimate.evidence
        self.balance, self.range_variance = estimate.balance, estimate.range_variance
        if estimate.nearest is not None:
            self._seen_nearest = estimate.nearest, list(fitted)
        self._gains.clear()
        set_log_gains(dive, fitted, estimate.exposure)

        seen, new = radiance(shown), self.water(fitted[0])
        if old is not None:
            seen = seen * old.transmission(z) + old.backscatter(z)
        new_gains = torch.stack([gain_of(view) for view in fitted])
        seen = seen * (old_gains / new_gains)[nearest]
        wanted = raw_colour(seen if new is None else new.restore(seen, z)[0])
        raw = self.gaussians.parameters["raw_colours"]
        # A decoder's residuals come on top again.
        raw.copy_(wanted if self.neural is None else wanted + (raw - shown))
