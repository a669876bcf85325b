"""The optimiser's steps where the renderer is wgpu's: the map stays on the GPU between them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.config import LossConfig
from aquaflow.mapping.scene import Scene
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.views import View
from aquaflow.render.webgpu import WgpuRenderer, camera_bits, drawn_tiles
from aquaflow.render.webgpu_device import shared_device
from aquaflow.render.webgpu_map import MapOnGpu, Observed, Outcome, Weights

SAVE_EVERY = 50
"""Steps after which the map comes down: so many are lost with a GPU that is. A map of 100,000
Gaussians and its moments are 19 MB."""


class GpuSteps:
    """Takes steps of a scene's optimiser on the GPU, as long as that works."""

    def __init__(self, renderer: WgpuRenderer, scene: Scene, config: LossConfig) -> None:
        self._renderer, self._scene = renderer, scene
        weights = Weights(config.ssim, config.depth, config.scale, config.tau_e)
        self._map = MapOnGpu(shared_device(), weights)
        self._since_saved = 0

    @property
    def works(self) -> bool:
        """False where the GPU failed, and for scenes whose steps it does not know: with a decoder,
        or with lamps."""
        scene = self._scene
        return self._renderer.failed is None and scene.neural is None and scene.lamp is None

    def step(
        self,
        view: View,
        active: Tensor | None,  # [rows, columns] bool, the tiles to draw
        learn: bool,
        water: Tensor | None,  # [5, 3] the medium for this view
        adam: SelectiveAdam,
    ) -> Outcome | None:
        """Draw, compare, differentiate, move the Gaussians; None where the GPU failed, and the map
        is on the host as it was saved last. With ``learn`` the view's light follows its picture."""
        try:
            if not self._map.is_loaded:
                self._map.load(self._scene.gaussians.parameters, adam)
                self._since_saved = 0
            outcome = None
            while outcome is None:
                self._draw(view, active, learn, water)
                outcome = self._map.finish(adam, errors=learn)
            self._since_saved += 1
            if self._since_saved >= SAVE_EVERY:
                self._save(adam)
            return outcome
        except Exception as error:  # of drivers, which say what they like
            self._renderer.leave_gpu(error)
            self._map.is_loaded = False
            return None

    def settle(self, adam: SelectiveAdam) -> None:
        """The map is on the host, as it is; what is changed there goes up at the next step."""
        if not self._map.is_loaded:
            return
        try:
            if self._since_saved:
                self._save(adam)
        except Exception as error:  # as in a step
            self._renderer.leave_gpu(error)
        self._map.is_loaded = False

    def radius_px(self) -> Tensor:
        """[N] of the view of the last step; zeros, as of what is not seen, where the GPU failed
        since."""
        try:
            return self._map.radius_px()
        except Exception as error:  # as in a step
            self._renderer.leave_gpu(error)
            return torch.zeros(len(self._scene.gaussians))

    def _save(self, adam: SelectiveAdam) -> None:
        self._map.save(self._scene.gaussians.parameters, adam)
        self._since_saved = 0

    def _draw(
        self,
        view: View,
        active: Tensor | None,  # [rows, columns] bool
        learn: bool,
        water: Tensor | None,  # [5, 3]
    ) -> None:
        scene = self._scene
        observed = _observe(view, active, water, len(scene.gaussians))
        if learn and scene.learns_light:
            self._map.draw(observed, _gains(scene, view, lit=False))
            scene.learn_light(view, *self._map.picture())
            self._map.relight(_gains(scene, view))
        else:
            self._map.draw(observed, _gains(scene, view))


def _observe(
    view: View,
    active: Tensor | None,  # [rows, columns] bool
    water: Tensor | None,  # [5, 3]
    count: int,
) -> Observed:
    width, height = view.camera.width, view.camera.height
    pixels = np.zeros((height, width, 3), np.uint32)
    bytes_of = pixels.view(np.uint8).reshape(height, width, 3, 4)
    bytes_of[..., 0, :3] = view.image
    bytes_of[..., 0, 3] = 255 if view.mask is None else 255 * view.mask
    inverse_range, confidence = view.inverse_range, view.range_confidence
    if inverse_range is not None and confidence is not None:
        pixels[..., 1] = inverse_range.numpy().view(np.uint32)
        pixels[..., 2] = confidence.numpy().view(np.uint32)
    viewmat = view.viewmat()
    return Observed(
        viewmat,
        camera_bits(viewmat, view.K(), width, height, count),
        (width, height),
        drawn_tiles(active, width, height),
        pixels,
        inverse_range is not None,
        1.0 / view.T_wc.scale,
        view.robust,
        water,
    )


def _gains(scene: Scene, view: View, lit: bool = True) -> npt.NDArray[np.float32] | None:
    """[H, W, 4] the shading, ``lit`` times the view's own light, and the backscatter's gain."""
    gain, uneven = scene.gain(view), scene.uneven(view)
    light = scene.sunlight.over(view, scene.exposure(view)) if lit else None
    if gain is None and uneven is None and light is None:
        return None
    gains = torch.ones(view.camera.height, view.camera.width, 4)
    if gain is not None:
        gains[..., :3] *= gain[..., None]
    if light is not None:
        gains[..., :3] *= light
    if uneven is not None:
        gains[..., 3] = uneven
    found: npt.NDArray[np.float32] = gains.numpy()
    return found
