"""What is mapped: Gaussians, the water in front of them, and the shading of the camera."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from aquaflow.config import MediumConfig
from aquaflow.mapping.gaussians import GaussianMap, raw_colour
from aquaflow.mapping.image_formation import Water
from aquaflow.mapping.medium import Medium
from aquaflow.mapping.rendering import Shown, show
from aquaflow.mapping.shading import TERMS, gain_map
from aquaflow.mapping.sightings import sight
from aquaflow.mapping.views import View
from aquaflow.mapping.water_estimation import WaterEstimate, estimate_water
from aquaflow.render.contract import Renderer


class Scene:
    """One sub-map's contents; draws them, and fits the water to what the views saw."""

    def __init__(
        self, config: MediumConfig, renderer: Renderer, generator: torch.Generator
    ) -> None:
        self.config, self.renderer = config, renderer
        self.gaussians = GaussianMap()
        self.medium = Medium(config, generator)
        self.shading = np.zeros(TERMS)
        """Coefficients of the log-gain over the picture."""
        self.beta_a_sigma: list[float] | None = None
        """Relative standard deviation of beta_a in the last fit; None before it."""
        self._gains: dict[tuple[int, int], Tensor] = {}

    def water(self, view: View) -> Water | None:
        """The medium for this view, or None while it is switched off."""
        if not self.medium.active:
            return None
        R_wc = torch.from_numpy(view.T_wc.R).to(torch.float32)
        return self.medium(R_wc)  # type: ignore[no-any-return]

    def gain(self, view: View) -> Tensor | None:
        """The shading [H, W] of this view's pictures; None where there is none."""
        if not self.shading.any():
            return None
        size = (view.camera.height, view.camera.width)
        if size not in self._gains:
            self._gains[size] = torch.from_numpy(gain_map(self.shading, *size))
        return self._gains[size]

    def draw(
        self,
        view: View,
        parameters: Mapping[str, Tensor] | None = None,
        viewmat: Tensor | None = None,  # [4, 4]
    ) -> Shown:
        """The scene from ``view``; differentiable in what is given, and in the medium."""
        return show(
            parameters if parameters is not None else self.gaussians.parameters,
            self.water(view),
            self.gain(view),
            self.renderer,
            view,
            view.viewmat() if viewmat is None else viewmat,
        )

    @torch.no_grad()
    def show(self, view: View) -> Shown:
        """The scene from ``view``, for looking."""
        return self.draw(view)

    @torch.no_grad()
    def restore(
        self,
        view: View,
        z: Tensor,  # [H, W] range
    ) -> tuple[Tensor, Tensor]:
        """J-hat [H, W, 3] of the view's picture, and where it can be believed [H, W]."""
        image, gain, water = view.target(), self.gain(view), self.water(view)
        if gain is not None:
            image = image / gain[..., None]
        if water is None:
            return image, torch.ones(image.shape[:2], dtype=torch.bool)
        return water.restore(image, z)

    def fit_water(self, views: list[View], generator: torch.Generator) -> WaterEstimate | None:
        """Estimate water and shading from what the views saw; the pictures stay as they are.

        None, and nothing changes, while too few Gaussians are seen over a span of ranges.
        """
        wanted = self.config.fit and self.medium.active
        if not wanted or not views or len(self.gaussians) == 0:
            return None
        seen = sight(self.gaussians, views, self.renderer, generator)
        old = self.water(views[0])
        assert old is not None
        estimate = estimate_water(
            seen,
            old.B_res.detach().double().numpy(),
            old.d.detach().double().numpy(),
            float(old.beta_a.detach().mean()),
            self.config.shading,
        )
        if estimate is None:
            return None
        beta_a, B_inf, b = (
            torch.from_numpy(values).to(torch.float32)
            for values in (estimate.beta_a, estimate.B_inf, estimate.b)
        )
        self.medium.set_water(beta_a, B_inf, b)
        self.shading = estimate.shading
        self.beta_a_sigma = estimate.beta_a_sigma.tolist()
        self._gains.clear()
        self._recolour(views, old)
        return estimate

    @torch.no_grad()
    def _recolour(self, views: list[View], old: Water) -> None:
        """Give every Gaussian the radiance that looks the same through the new water.

        The range is that from the camera nearest to it: where it is seen best.
        """
        new = self.water(views[0])
        assert new is not None
        centres = torch.from_numpy(np.stack([view.T_wc.t for view in views])).to(torch.float32)
        z = torch.cdist(self.gaussians.means, centres).amin(dim=1)
        seen = self.gaussians.colours * old.transmission(z) + old.backscatter(z)
        clear, _ = new.restore(seen, z)
        self.gaussians.parameters["raw_colours"].copy_(raw_colour(clear))
