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
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from aquaflow.config import LossConfig, MappingConfig, OptimiserConfig
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.mapping.gpu_steps import GpuSteps
from aquaflow.mapping.neural.decoder import DECODED
from aquaflow.mapping.scene import RenderedMap, Scene
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.contract import TILE_PX, active_pixels
from aquaflow.render.dense_adam import DenseAdam
from aquaflow.render.photometric import (
    depth_loss,
    outlier_mask,
    photometric_loss,
    radial_weight,
)
from aquaflow.render.transfers import pose_in, registration_out
from aquaflow.render.views import View
from aquaflow.render.views import refine_pose as refine_pose_of
from aquaflow.render.webgpu import WgpuRenderer
from aquaflow.water.exposure import log_gain_at, set_log_gain
from aquaflow.water.sunlight import light_at

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
        if (
            self._gpu is None
            or not self._gpu.works
            or not self._step_on_gpu(view, active, refine_pose)
        ):
            self._step_here(view, active, refine_pose)

    def _step_here(
        self,
        view: View,
        active: Tensor | None,  # [rows, columns] bool, the tiles to draw
        refine_pose: bool,
    ) -> None:
        leaves = {
            name: tensor.detach().requires_grad_(self._is_optimised(name))
            for name, tensor in self.scene.gaussians.parameters.items()
        }
        viewmat = view.viewmat().requires_grad_(refine_pose)
        neural = self.scene.neural
        seen = leaves if neural is None else neural.decode(view, leaves, viewmat)
        # Water and a view's light hardly change from step to step: full looks follow them.
        learn = is_full_look(view, self.config.optimiser)
        shown = self.scene.draw(view, seen, viewmat, learn, active)
        errors = tile_errors(view, shown.image) if learn else None
        record_look(view, errors, self.config.optimiser)
        loss = self._objective.total(view, shown, seen)
        if not is_number(loss):
            self._undo("loss", view)
            self.drop_unsound()
            return
        torch.autograd.backward(loss)
        gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
        self.adam.step(shown.visible, gradients)
        self._step_medium(view)
        if viewmat.grad is not None:
            refine_pose_of(view, viewmat.grad, self.config.optimiser.poses)
        self._count_step(view, lambda: shown.radius_px)

    def _step_on_gpu(
        self,
        view: View,
        active: Tensor | None,  # [rows, columns] bool, the tiles to draw
        refine_pose: bool,
    ) -> bool:
        """The same as :meth:`_step_here`; False where the GPU failed and nothing was done."""
        gpu, learn = self._gpu, is_full_look(view, self.config.optimiser)
        assert gpu is not None
        water_learns = learn or self.scene.medium.directional  # as in Scene.draw
        with torch.set_grad_enabled(water_learns):
            water = self.scene.water(view)
            stack = None if water is None else water.stack()
        outcome = gpu.step(view, active, learn, stack, self.adam)
        if outcome is None:
            return False
        record_look(view, outcome.errors, self.config.optimiser)
        if not math.isfinite(outcome.loss):
            self._undo("loss", view)
            self.drop_unsound()
            return True
        if stack is not None and stack.requires_grad:
            torch.autograd.backward(stack, outcome.g_water)
        self._step_medium(view)
        if refine_pose:
            refine_pose_of(view, outcome.g_viewmat, self.config.optimiser.poses)
        self._count_step(view, gpu.radius_px)
        return True

    def _count_step(self, view: View, radius_px: Callable[[], Tensor]) -> None:
        """Count a step, and prune now and then; ``radius_px`` [N] is asked for only then."""
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


# --------------------------------------------------------------------------------------------------
# Pose of a view that was never mapped: its picture is aligned with the frozen map.
#
# Gauss-Newton over the six numbers of a left tangent of the view matrix. The derivatives of the
# drawing are differences of drawings, each from a pose that moves the picture by a fraction of a
# pixel: six drawings and no gradient of the renderer. They are kept while the pose hardly moves, so
# that most steps take one drawing where ``optimise.minimise``, which linearises after every step,
# would take seven; and the sums over pixels stay on the renderer's device.

Array = npt.NDArray[np.float64]

TRIAL_PX = 0.5
"""How far a trial pose moves the picture: far above float32's rounding, less than the width of an
edge."""
ROBUST = 0.05
"""Of full scale; residuals beyond count linearly (Huber). Noise and 8 bits stay below it, fish and
marine snow do not."""
SOLID = 0.5
"""Alpha above which the drawing's range says how far away the scene is."""
FAR_PX = 0.5
"""After a step that moves the picture further, the derivatives are taken again."""
CONVERGED_PX = 0.02
"""A shorter step is the last: what it changes is below 0.01 dB."""
DAMPING = 1e-3
"""Share of the normal matrix's diagonal added to it, for motions that the picture hardly shows."""


def take_light(
    view: View,
    mapped: Sequence[View],  # in the order of their frames
) -> None:
    """Give a view that was never mapped the exposure and the light of its neighbours in time:
    nothing of them is learned from its own picture (the peers do so for exposure)."""
    if mapped:
        set_log_gain(view, log_gain_at(view.frame_index, mapped))
        view.light = light_at(view.frame_index, mapped)


def register(view: View, scene: Scene, config: OptimiserConfig) -> None:
    """Refine the pose of ``view`` photometrically; it stays where no step fits better."""
    if config.heldout_steps == 0 or len(scene.gaussians) == 0:
        return
    pose = _align(_Picture(view, scene), config.heldout_steps)
    R, t = pose[:3, :3], pose[:3, 3]
    # The identity puts a product of rotations back on the group.
    view.T_wc = (Sim3(R.T, -R.T @ t, view.T_wc.scale) @ Sim3.identity()).if_finite()


def _align(picture: _Picture, most_steps: int) -> Array:
    """The view matrix [4, 4] at which the map fits best."""
    fit = picture.fit(picture.view.world_to_camera())
    trial = picture.trial()
    derivatives: Tensor | None = None
    for _ in range(most_steps):
        if derivatives is None:
            derivatives = picture.derivatives(fit, trial)
        step = _gauss_newton_step(fit, derivatives)  # in units of ``trial``
        moved = picture.fit(_move(fit.viewmat, step * trial))
        if not moved.cost < fit.cost:
            break
        fit, moved_px = moved, TRIAL_PX * float(np.abs(step).max())
        if moved_px < CONVERGED_PX:
            break
        if moved_px > FAR_PX:
            derivatives = None
    return fit.viewmat


@dataclass(frozen=True)
class _Registration:
    """The map drawn from one pose, against the picture."""

    viewmat: Array
    """[4, 4] world to camera."""
    image: Tensor
    """[P, 3] the drawing; P pixels."""
    residual: Tensor
    """[P, 3] drawing minus picture."""
    weight: Tensor
    """[P, 3] of the robust least squares."""
    cost: float


class _Picture:
    """The picture of a view, and the map drawn from poses near that of the view."""

    def __init__(self, view: View, scene: Scene) -> None:
        self.view, self._scene = view, scene
        camera = view.camera
        self._target = view.target().reshape(-1, 3)
        weight = radial_weight(camera.height, camera.width, view.device) * view.scene_mask()
        self._weight = weight.reshape(-1, 1)
        self._parameters = scene.seen_from(view, view.viewmat())

    @torch.no_grad()
    def fit(
        self,
        viewmat: Array,  # [4, 4]
    ) -> _Registration:
        """The map from this pose."""
        image = self._draw(viewmat)
        residual = image - self._target
        size = residual.abs()
        beyond = ROBUST / size.clamp_min(ROBUST)  # 1 where it is not beyond
        loss = torch.where(size > ROBUST, ROBUST * (size - 0.5 * ROBUST), 0.5 * size * size)
        cost = float(registration_out((self._weight * loss).sum(dtype=torch.float64)))
        return _Registration(viewmat, image, residual, self._weight * beyond, cost)

    def trial(self) -> Array:
        """[6] steps of the tangent that each move the picture by about ``TRIAL_PX``."""
        shown = self._scene.show(self.view)
        z = shown.z[shown.alpha > SOLID]
        z_median = float(registration_out(z.median())) if len(z) else 1.0
        turn = TRIAL_PX / self.view.camera.fx
        return np.array([turn * z_median] * 3 + [turn] * 3)

    @torch.no_grad()
    def derivatives(
        self,
        fit: _Registration,
        trial: Array,  # [6]
    ) -> Tensor:
        """[6, P, 3] how each trial step of the tangent changes the drawing."""
        steps = np.diag(trial)
        return torch.stack([self._draw(_move(fit.viewmat, step)) - fit.image for step in steps])

    def _draw(
        self,
        viewmat: Array,  # [4, 4]
    ) -> Tensor:
        """[P, 3] the map's colours."""
        where = pose_in(viewmat, self.view.device)
        return self._scene.draw(self.view, self._parameters, where).image.reshape(-1, 3)


def _gauss_newton_step(
    fit: _Registration,
    derivatives: Tensor,  # [6, P, 3]
) -> Array:
    """[6] of the tangent, in units of the trial steps."""
    weighted = (derivatives * fit.weight).reshape(6, -1)
    normal = weighted @ derivatives.reshape(6, -1).T
    gradient = weighted @ fit.residual.reshape(-1)
    found = registration_out(torch.cat([normal, gradient[:, None]], dim=1)).astype(np.float64)
    A, b = found[:, :6], found[:, 6]
    A[np.diag_indices(6)] += DAMPING * A.diagonal() + np.finfo(np.float32).eps
    if not np.isfinite(found).all():
        return np.zeros(6)
    return np.asarray(-np.linalg.solve(A, b))


def _move(
    viewmat: Array,  # [4, 4]
    tangent: Array,  # [6] translation, map units, then rotation, rad; in the camera's axes
) -> Array:
    """[4, 4] ``viewmat`` moved by the left tangent."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = so3_exp(tangent[3:]), tangent[:3]
    return motion @ viewmat
