"""The joint optimisation of Gaussians, medium and pose (paper, Sec. 3.4): steps, loss, poses.

It owns the optimisers' state, which has a row for every Gaussian; Gaussians are therefore added and
dropped through it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from aquaflow.config import LossConfig, MappingConfig, OptimiserConfig
from aquaflow.geometry.arrays import Arrays
from aquaflow.mapping.gpu_steps import GpuSteps
from aquaflow.mapping.neural.decoder import DECODED
from aquaflow.mapping.scene import RenderedMap, Scene
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.contract import active_pixels
from aquaflow.render.dense_adam import DenseAdam
from aquaflow.render.limits import TILE_PX
from aquaflow.render.photometric import (
    depth_loss,
    outlier_mask,
    photometric_loss,
    radial_weight,
)
from aquaflow.render.views import View, refine_pose
from aquaflow.render.webgpu import WgpuRenderer

log = logging.getLogger(__name__)

MAX_GRADIENT = 0.01
"""Largest gradient norm of the medium that is kept (WaterSplatting clips at 0.001)."""
PRUNE_RADIUS_WIDTHS = 0.5
"""Radius over image width from which a Gaussian is pruned."""


def is_number(
    value: Tensor,  # []
) -> bool:
    """True if a loss or a norm is finite, so that a step may use it."""
    return bool(torch.isfinite(value))


class MapOptimiser:
    """Optimises a scene against its views, one step at a time."""

    def __init__(self, config: MappingConfig, scene: Scene, objective: Objective) -> None:
        """Start at step 0, with rows for the Gaussians that the scene has now."""
        self.config, self.scene = config, scene
        self._objective = objective
        self.adam = self._new_adam()
        """Optimiser of the Gaussians' parameters."""
        renderer = scene.renderer
        self._gpu: GpuSteps | None = None
        """Takes the steps where the renderer can; None: they are taken here."""
        if isinstance(renderer, WgpuRenderer):
            self._gpu = GpuSteps(renderer, scene, config.loss)
        self.medium_adam = DenseAdam(scene.medium.learned_at(config.medium))
        self.steps = 0
        """Steps taken."""
        self.undone = 0
        """Steps that were undone because their loss or gradient was not finite."""

    def _new_adam(self) -> SelectiveAdam:
        rates, parameters = self.config.optimiser, self.scene.gaussians.parameters
        groups = {name: (tensor, getattr(rates, name)) for name, tensor in parameters.items()}
        return SelectiveAdam(groups, rates.betas, threads=self.scene.renderer.threads)

    def slow_down(self, rates: Rates) -> None:
        """Let the following steps go so far."""
        for name in self.scene.gaussians.NAMES:
            factor = rates.means if name == "means" else rates.others
            self.adam.learning_rates[name] = factor * float(getattr(self.config.optimiser, name))
        if self.scene.neural is not None:
            self.scene.neural.slow_down(rates.means)

    # --- one step -----------------------------------------------------------------------------

    def step(self, view: View, refine_pose: bool) -> None:
        """Render, compare (Eqs. 18 to 23), differentiate, move; undone if anything is not finite.

        The view's pose moves too if ``refine_pose``.
        """
        if len(self.scene.gaussians) == 0:  # all pruned since the steps began
            return
        config = self.config.optimiser
        active = tiles_to_draw(view, config)
        if config.skip_explained and is_nothing_to_draw(view, active, config):
            view.looks += 1
            return
        self.medium_adam.forget_gradients()
        gpu = self._gpu
        if gpu is None or not gpu.works or not self._step_on_gpu(gpu, view, active, refine_pose):
            self._step_here(view, active, refine_pose)

    def _step_here(
        self,
        view: View,
        active: Tensor | None,  # [rows, columns] bool, the tiles to draw
        with_pose: bool,
    ) -> None:
        leaves = {
            name: tensor.detach().requires_grad_(self._is_optimised(name))
            for name, tensor in self.scene.gaussians.parameters.items()
        }
        viewmat = view.viewmat().requires_grad_(with_pose)
        neural = self.scene.neural
        seen = leaves if neural is None else neural.decode(view, leaves, viewmat)
        # Water and a view's light hardly change from step to step: full looks follow them.
        learn = is_full_look(view, self.config.optimiser)
        shown = self.scene.draw(view, seen, viewmat, learn, active)
        errors = tile_errors(view, shown.image) if learn else None
        record_look(view, errors, self.config.optimiser)
        loss = self._objective.total(view, shown, seen)
        if not is_number(loss):
            self._undo_loss(view)
            return
        torch.autograd.backward(loss)
        gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
        self.adam.step(shown.visible, gradients)
        self._finish_step(view, viewmat.grad, lambda: shown.radius_px)

    def _step_on_gpu(
        self,
        gpu: GpuSteps,
        view: View,
        active: Tensor | None,  # [rows, columns] bool, the tiles to draw
        with_pose: bool,
    ) -> bool:
        """The same as :meth:`_step_here`; False where the GPU failed and nothing was done."""
        learn = is_full_look(view, self.config.optimiser)
        water_learns = learn or self.scene.medium.directional  # as in Scene.draw
        with torch.set_grad_enabled(water_learns):
            water = self.scene.water(view)
            stack = None if water is None else water.stack()
        outcome = gpu.step(view, active, learn, stack, self.adam)
        if outcome is None:
            return False
        record_look(view, outcome.errors, self.config.optimiser)
        if not math.isfinite(outcome.loss):
            self._undo_loss(view)
            return True
        if stack is not None and stack.requires_grad:
            torch.autograd.backward(stack, outcome.g_water)
        self._finish_step(view, outcome.g_viewmat if with_pose else None, gpu.radius_px)
        return True

    def _undo_loss(self, view: View) -> None:
        self._undo("loss", view)
        self.drop_unsound()

    def _finish_step(
        self,
        view: View,
        g_viewmat: Tensor | None,  # [4, 4]
        radius_px: Callable[[], Tensor],  # [N], asked for only where it is needed
    ) -> None:
        """Move the water and the pose; prune now and then."""
        self._step_medium(view)
        if g_viewmat is not None:
            refine_pose(view, g_viewmat, self.config.optimiser.poses)
        self.steps += 1
        if self.steps % self.config.optimiser.prune_every == 0:
            self._prune(radius_px(), view)

    @contextmanager
    def stepping(self) -> Iterator[None]:
        """Steps may leave the map on the GPU within; after it, it is on the host."""
        try:
            yield
        finally:
            self.settle()

    def settle(self) -> None:
        """Let the Gaussians' parameters and their moments be on the host, as they are."""
        if self._gpu is not None:
            self._gpu.settle(self.adam)

    def _is_optimised(self, name: str) -> bool:
        """Means and opacities always are; with residuals, the rest only if configured."""
        frozen = self.scene.neural is not None and not self.config.decoder.optimise_initial
        return not (frozen and name in DECODED)

    def _step_medium(self, view: View) -> None:
        medium = self.scene.medium
        if all(tensor.grad is None for tensor in self.medium_adam.tensors):
            return
        norm = torch.nn.utils.clip_grad_norm_(medium.parameters(), MAX_GRADIENT)
        if not is_number(norm):
            self._undo("medium gradient", view)
            return
        self.medium_adam.step()

    def _undo(self, what: str, view: View) -> None:
        self.undone += 1
        log.warning("non-finite %s on frame %d: step undone", what, view.frame_index)

    # --- adding and dropping Gaussians --------------------------------------------------------

    def extend(
        self,
        count: int,
        centres: Tensor | None,  # [3] or [count, 3]
    ) -> None:
        """Add rows for the map's last ``count`` Gaussians, which were seen from the cameras at
        ``centres``; only a decoder uses these."""
        self.settle()
        self.adam.extend(count)
        if self.scene.neural is not None and centres is not None:
            self.scene.neural.insert(centres, count)
        self.adam.bind(self.scene.gaussians.parameters)

    def take_back(
        self,
        states: Sequence[Arrays],  # as from Tiles.bring, in the order of the map's last Gaussians
    ) -> None:
        """Give the map's last Gaussians the rows with which they left."""
        self.settle()

        def joined(name: str) -> Tensor:
            return torch.from_numpy(np.concatenate([arrays[name] for arrays in states]))

        names = self.scene.gaussians.NAMES
        first, second = (
            {n: joined(f"{which}.{n}") for n in names} for which in ("first", "second")
        )
        self.adam.extend_with(joined("steps"), first, second)
        self.adam.bind(self.scene.gaussians.parameters)

    def keep(
        self,
        mask: Tensor,  # [N] bool
    ) -> None:
        """Drop the Gaussians where ``mask`` is False, their optimiser state with them."""
        self.settle()
        if not bool(mask.all()):
            (self.scene.neural or self.scene.gaussians).keep(mask)
            self.adam.keep(mask)
            self.adam.bind(self.scene.gaussians.parameters)

    def _prune(
        self,
        radius_px: Tensor,  # [N]
        view: View,
    ) -> None:
        """Drop Gaussians that are almost transparent, or that fill the picture."""
        self.settle()
        opaque = self.scene.gaussians.opacities > self.config.optimiser.prune_opacity
        widest = PRUNE_RADIUS_WIDTHS * view.camera.width
        self.keep(opaque & (radius_px < widest))

    def drop_unsound(self) -> None:
        """Drop Gaussians that are not finite: the scale loss of one would spoil every step."""
        self.settle()
        sound = torch.isfinite(self.scene.gaussians.scales.prod(dim=-1))
        for tensor in self.scene.gaussians.parameters.values():
            sound &= torch.isfinite(tensor).all(dim=-1)
        self.keep(sound)

    def make_whole(self) -> None:
        """Repair after a failure: every row of the optimisers and groups belongs to a Gaussian, and
        all Gaussians are finite."""
        self.settle()
        if self.scene.neural is not None:
            self.scene.neural.make_whole()
        missing = len(self.scene.gaussians) - len(self.adam.steps)
        if missing > 0:  # Gaussians are added before their rows, and dropped before them too
            self.adam.extend(missing)
        elif missing < 0:
            self.adam = self._new_adam()
        self.adam.bind(self.scene.gaussians.parameters)
        self.drop_unsound()


# --------------------------------------------------------------------------------------------------
# Active tiles of a view in a step: neither on the vehicle nor explained already.
#
# A tile whose error is no more than the camera's own noise can teach the map nothing; it is neither
# drawn nor differentiated until the next full drawing of its view, which may show that the map
# around it has changed.


def is_full_look(view: View, config: OptimiserConfig) -> bool:
    """True if the view's next step draws all of it."""
    return view.looks % config.full_look_every == 0


def tiles_to_draw(view: View, config: OptimiserConfig) -> Tensor | None:
    """[rows, columns] bool of the view's tiles for its next step; None: all of them."""
    if config.noise_floor == 0.0:
        return None
    explained = None if is_full_look(view, config) else view.explained
    if view.mask is None:
        return None if explained is None else ~explained
    scene = F.max_pool2d(view.scene_mask()[None].float(), TILE_PX, ceil_mode=True)[0] > 0.0
    return scene if explained is None else scene & ~explained


def is_nothing_to_draw(
    view: View,
    active: Tensor | None,  # [rows, columns] bool, from tiles_to_draw
    config: OptimiserConfig,
) -> bool:
    """True if no tile is active; between two full looks the device is asked only once."""
    if active is None:
        return False
    if is_full_look(view, config):
        return not bool(active.any())
    if view.all_explained is None:
        view.all_explained = not bool(active.any())
    return view.all_explained


@torch.no_grad()
def tile_errors(
    view: View,
    image: Tensor,  # [H, W, 3] the map from this view
) -> Tensor:
    """[rows, columns] mean error of each tile, of full scale, where the view shows the scene."""
    error = (image - view.target()).abs().mean(dim=-1)
    if view.mask is not None:
        error *= view.scene_mask()
    return F.avg_pool2d(error[None], TILE_PX, ceil_mode=True)[0]


def record_look(
    view: View,
    errors: Tensor | None,  # [rows, columns] of its tiles, after a full drawing
    config: OptimiserConfig,
) -> None:
    """Count the step; after a full drawing record which tiles are explained."""
    if errors is not None:
        view.explained, view.all_explained = errors < config.noise_floor, None
    view.looks += 1


# --------------------------------------------------------------------------------------------------
# L_total of one view (paper, Eq. 19).


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


# --------------------------------------------------------------------------------------------------
# What the loss has beside the terms of a view: Eq. 23.


def scale_loss(
    log_scales: Tensor,  # [N, 3]
) -> Tensor:
    """L_scale: mean volume, which keeps Gaussians from growing over what they do not explain."""
    return torch.exp(log_scales.sum(dim=-1)).mean()


# --------------------------------------------------------------------------------------------------
# Selects the view of each optimiser step, and how far it goes (paper, Sec. 3.4).


def sampled_views(
    views: Sequence[View],
    steps: int,
    newest_share: float,
    generator: torch.Generator,
) -> list[View]:
    """One view for each step during the dive: sometimes the newest, else a random one."""
    chosen = []
    for _ in range(steps if views else 0):
        newest = torch.rand((), generator=generator) < newest_share
        index = int(torch.randint(len(views), (), generator=generator))
        chosen.append(views[-1 if newest else index])
    return chosen


def shuffled_views(views: Sequence[View], steps: int, generator: torch.Generator) -> list[View]:
    """One view a step after the dive: all of them in random order, then again in another."""
    order: list[int] = []
    while views and len(order) < steps:
        order += reversed(torch.randperm(len(views), generator=generator).tolist())
    return [views[index] for index in order[:steps]]


@dataclass(frozen=True)
class Rates:
    """Factors of the learning rates."""

    means: float
    others: float


SLACK = 0.1
"""Share of the time that the steps may be behind before they are hurried."""


def share_done(step: int, steps: int, passed: float) -> float:
    """Share of the refinement that is done at ``step`` of ``steps``, when the share ``passed`` of
    the time is over: that of the steps, as long as the time will do for them, so that the same
    dive gives the same bytes; else that of the time."""
    return max(step / max(steps - 1, 1), (passed - SLACK) / (1.0 - SLACK))


def refining_rates(done: float, config: OptimiserConfig) -> Rates:
    """The rates after the share ``done`` of refining.

    Those of the means fall from the start. At the end all fall: what each view pulls its own way
    settles at the mean of the views.
    """
    left = 1.0 - config.settle_share
    settling = max(done - left, 0.0) / config.settle_share if config.settle_share else 0.0
    others = config.settle_final**settling
    return Rates(config.means_final**done * others, others)
