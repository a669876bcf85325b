"""L_total of one view (paper, Eq. 19)."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from aquaflow.config import LossConfig
from aquaflow.mapping.optimisation.losses import radial_weight, scale_loss
from aquaflow.mapping.rendering import RenderedMap
from aquaflow.render.activity import active_pixels
from aquaflow.render.photometric import photometric_loss
from aquaflow.render.view_loss import depth_loss, outlier_mask
from aquaflow.render.views import View


class Objective:
    """The weighted sum of the paper's terms; keeps K_rad for every size of picture."""

    def __init__(self, config: LossConfig, threads: int) -> None:
        self.config, self.threads = config, threads
        self._K_rad: dict[tuple[int, int], Tensor] = {}

    def total(
        self,
        view: View,
        shown: RenderedMap,
        parameters: Mapping[str, Tensor],  # of a GaussianMap
    ) -> Tensor:
        """L1, SSIM, depth and scale terms of ``shown``, the map drawn from ``view``."""
        config, target = self.config, view.target()
        mask = view.scene_mask()
        if shown.active is not None:
            mask &= active_pixels(shown.active, view.camera.width, view.camera.height)
        if view.robust:
            image, K_rad = shown.image, self.radial(view)
            mask &= outlier_mask(image, target, K_rad, config.tau_e, self.threads)
        loss = self._pictures(view, shown, target, mask)
        inverse_range = view.inverse_range
        if config.depth > 0.0 and inverse_range is not None:
            assert view.range_confidence is not None
            trust = self.radial(view) * mask * view.range_confidence
            # The view's ranges are in its keyframe's unit; the map is in the world's.
            expected = inverse_range / view.T_wc.scale
            ranges = depth_loss(shown.z, shown.alpha, expected, trust, self.threads)
            loss = loss + config.depth * ranges
        if config.scale > 0.0:
            loss = loss + config.scale * scale_loss(parameters["log_scales"])
        return loss

    def _pictures(
        self,
        view: View,
        shown: RenderedMap,
        target: Tensor,  # [H, W, 3]
        mask: Tensor,  # [H, W] bool
    ) -> Tensor:
        return photometric_loss(
            shown.image, target, self.radial(view), mask, self.config.ssim, self.threads
        )

    def radial(self, view: View) -> Tensor:
        """K_rad [H, W]."""
        size = (view.camera.height, view.camera.width)
        if size not in self._K_rad:
            self._K_rad[size] = radial_weight(*size, view.device)
        return self._K_rad[size]
