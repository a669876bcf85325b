"""The map of one sub-map: views in, Gaussians and water out (paper, Sec. 3.3 and 3.4)."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from aquaflow.config import MappingConfig
from aquaflow.errors.failures import Failures
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.mapping.decoder.decode import DECODED
from aquaflow.mapping.decoder.neural import NeuralGaussians
from aquaflow.mapping.gaussians.gaussians import GaussianMap
from aquaflow.mapping.gaussians.insertion import (
    confidence_of,
    insertion_probability,
    new_gaussians,
    range_of,
    select,
    thin,
    worth_keeping,
)
from aquaflow.mapping.gaussians.reanchoring import move_gaussians, move_views
from aquaflow.mapping.optimisation.active_tiles import look, tiles_to_draw
from aquaflow.mapping.optimisation.objective import Objective
from aquaflow.mapping.optimisation.pose_refinement import register
from aquaflow.mapping.optimisation.schedule import sampled_views, shuffled_views
from aquaflow.mapping.rendering import Shown
from aquaflow.mapping.scene import Scene
from aquaflow.mapping.views import View, in_time, refine_pose
from aquaflow.mapping.water.medium import Medium
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.contract import Renderer

log = logging.getLogger(__name__)


MOST_FAILED_STEPS = 10
"""Steps in a row that raise until the final refinement gives up: the next would, too."""


def is_number(
    value: Tensor,  # []
) -> bool:
    """True if a loss or a norm may be acted on."""
    return bool(torch.isfinite(value))


class Mapper:
    """Owns the Gaussians, the medium, their optimisers and the views of one sub-map."""

    def __init__(
        self,
        config: MappingConfig,
        renderer: Renderer,
        seed: int,
        failures: Failures | None = None,
    ) -> None:
        """What a fit or a step raises is counted in ``failures`` and skipped."""
        self.config, self.renderer = config, renderer
        self.failures = failures or Failures()
        self._random = torch.Generator().manual_seed(seed)
        self.scene = Scene(config.medium, renderer, self._random, config.sunlight)
        self.views: list[View] = []
        self.steps = 0
        self._failed_in_a_row = 0
        """Steps that raised, since the last one that did not."""
        self.undone = 0
        """Steps that were undone because their loss or gradient was not finite."""
        rates = config.optimiser
        self._optimiser = self._new_optimiser()
        if config.decoder.enabled:
            drawn = torch.Generator().manual_seed(seed)  # its own: insertion is as without it
            self.scene.neural = NeuralGaussians(
                config.decoder, self.gaussians, rates.betas, drawn, renderer.threads
            )
        self._medium_optimiser = torch.optim.Adam(self.medium.parameters(), lr=config.medium.rate)
        self._next_water_fit = config.medium.first_fit_views
        self._objective = Objective(config.loss, renderer.threads)

    def _new_optimiser(self) -> SelectiveAdam:
        rates = self.config.optimiser
        groups = {name: (tensor, getattr(rates, name)) for name, tensor in self._parameters.items()}
        return SelectiveAdam(groups, rates.betas, threads=self.renderer.threads)

    # --- growing ------------------------------------------------------------------------------

    def add_view(self, view: View) -> None:
        """Let later optimisation steps use ``view``."""
        if self.views:
            view.log_gain, view.light = self.views[-1].log_gain, self.views[-1].light
        self.views.append(view)
        if len(self.views) >= self._next_water_fit:
            self._next_water_fit *= 2
            self.fit_water()
            self.scene.sunlight.judge(in_time(self.views))

    @torch.no_grad()
    def insert(self, view: View, pointmap: Pointmap) -> int:
        """Medium-guided insertion (paper, Sec. 3.3.3); returns the number of new Gaussians."""
        own_range, known = range_of(pointmap, self.config.insertion.known_sigma)
        prior_range = own_range * view.T_wc.scale
        shown = self.scene.show(view, learn=True)
        covered = shown.alpha > self.config.insertion.covered_alpha
        z = torch.where(known, prior_range, torch.where(covered, shown.z, 0.0))
        restored, recoverable = self.scene.restore(view, z)
        if not self.config.insertion.medium_reduced:
            restored = view.target()
        # Where the map already explains the ray with the same depth, only structure that the map
        # lacks asks for more; where it is bare or its surface lies elsewhere, any pixel may.
        agree = (shown.z - prior_range).abs() < self.config.insertion.agreement * prior_range
        solid = torch.where(agree, shown.alpha, 0.0)
        P = insertion_probability(restored, shown.radiance, solid, self.config.insertion)
        allowed = known & recoverable
        if view.mask is not None:
            allowed &= torch.from_numpy(view.mask)
        rows, columns = select(P, allowed, self.config.insertion, self._random)
        if len(rows) > self.config.max_gaussians - len(self.gaussians):
            bare = solid[rows, columns] < self.config.insertion.covered_alpha
            rows, columns = rows[bare], columns[bare]
        rows, columns = thin(rows, columns, self._room_for(len(rows)), self._random)
        confidence = confidence_of(pointmap)
        view.inverse_range = torch.where(known, 1.0 / own_range.clamp_min(1e-6), 0.0)
        view.range_confidence = confidence
        if len(rows) == 0:
            return 0
        new = new_gaussians(view, rows, columns, z, restored, confidence, P, self.config.insertion)
        self.gaussians.extend(new, view.keyframe)
        count = len(new["means"])
        self._optimiser.extend(count)
        if self.neural is not None:
            self.neural.insert(torch.from_numpy(view.T_wc.t).to(torch.float32), count)
        self._optimiser.bind(self._parameters)
        return count

    def _room_for(self, wanted: int) -> int:
        """How many Gaussians may come: at the hard cap, those least worth make room for them."""
        room = self.config.max_gaussians - len(self.gaussians)
        given = min(wanted - room, int(self.config.insertion.recycle * len(self.gaussians)))
        if given <= 0:
            return room
        self._keep(worth_keeping(self.gaussians, len(self.gaussians) - given))
        return room + given

    def fit_water(self) -> None:
        """Estimate the water from views spread over the dive so far."""
        count, views = self.config.medium.fit_views, in_time(self.views)
        chosen = np.linspace(0, len(views) - 1, min(count, len(views))).astype(int)
        estimate = None
        with self.failures.contain("water fit"):
            estimate = self.scene.fit_water([views[i] for i in chosen], self._random, views)
        if estimate is not None:
            log.info(
                "water fitted: %s, beta_a %s per map unit (relative sigma %s)",
                estimate.model,
                estimate.beta_a.round(3).tolist(),
                estimate.beta_a_sigma,
            )

    # --- following the keyframes --------------------------------------------------------------

    def move(self, moves: Mapping[int, Sim3]) -> None:
        """Let Gaussians and views follow moved keyframes (see gaussians/reanchoring.py)."""
        moved = move_gaussians(self.gaussians, moves)
        if self.neural is not None:
            self.neural.move(moved)
        move_views(self.views, moves)

    def absorb(self, other: Mapper) -> None:
        """Take over another sub-map's Gaussians and views, already moved into this one's world.

        The water stays this map's own: it is the same water, and is fitted again to all views. So
        does the decoder: what the other's says of its Gaussians, seen from its own views, is kept.
        """
        count, views = len(other.gaussians), in_time([*self.views, *other.views])
        # Only a decoder needs to know from where each is seen: cameras times Gaussians.
        centres = None if self.neural is None else other.scene.bake(other.views)
        self.gaussians.append(other.gaussians)
        self.views = views  # from here on make_whole mends what a failure leaves
        self._optimiser.extend(count)
        if self.neural is not None and centres is not None:
            self.neural.insert(centres, count)
        self._optimiser.bind(self._parameters)
        self.steps, self.undone = self.steps + other.steps, self.undone + other.undone

    # --- optimising ---------------------------------------------------------------------------

    def optimise(self, steps: int) -> None:
        """Steps on the newest view now and then, else on any (paper, Sec. 3.4)."""
        if len(self.gaussians) == 0:
            return
        share = self.config.optimiser.newest_share
        chosen = sampled_views(self.views, steps, share, self._random)
        with self.scene.learning_from(chosen):
            for view in chosen:
                self._contained_step("optimisation", view, refine_poses=False)

    def refine(self, progress: Callable[[int, int], None] | None = None) -> None:
        """The final refinement: all views in random order, rates falling, poses included."""
        steps, limit = self.config.optimiser.refine_steps, self.config.optimiser.refine_seconds
        started = time.monotonic()
        self.fit_water()
        order = shuffled_views(self.views, steps, self._random) if len(self.gaussians) else []
        with self.scene.learning_from(order):
            for step, view in enumerate(order):
                if limit is not None and time.monotonic() - started > limit:
                    break
                if step % len(self.views) == 0:  # light shows once the map has lost its errors
                    self.scene.sunlight.judge(in_time(self.views))
                factor = self.config.optimiser.means_final ** (step / max(steps - 1, 1))
                self._optimiser.learning_rates["means"] = self.config.optimiser.means * factor
                if self.neural is not None:
                    self.neural.slow_down(factor)
                self._contained_step("refinement", view, self.config.optimiser.poses > 0.0)
                if self._failed_in_a_row == MOST_FAILED_STEPS:
                    break
                if progress is not None:
                    progress(step + 1, steps)

    def _contained_step(self, stage: str, view: View, refine_poses: bool) -> None:
        with self.failures.contain(stage, view.frame_index) as step:
            self._step(view, refine_poses)
        self._failed_in_a_row = self._failed_in_a_row + 1 if step.failed else 0
        if step.failed:
            self.make_whole()

    def _step(self, view: View, refine_poses: bool) -> None:
        """Render, compare, differentiate, move; undone when anything is not finite."""
        if len(self.gaussians) == 0:  # all pruned since the steps began
            return
        leaves = {
            name: tensor.detach().requires_grad_(self._is_optimised(name))
            for name, tensor in self.gaussians.parameters.items()
        }
        viewmat = view.viewmat().requires_grad_(refine_poses)
        self._medium_optimiser.zero_grad(set_to_none=True)
        active = tiles_to_draw(view, self.config.optimiser)
        if self.config.optimiser.skip_explained and active is not None and not active.any():
            view.looks += 1
            return
        seen = leaves if self.neural is None else self.neural.decode(view, leaves, viewmat)
        shown = self.scene.draw(view, seen, viewmat, learn=True, active=active)
        look(view, shown.image, self.config.optimiser)
        loss = self._objective.total(view, shown, seen)
        if not is_number(loss):
            self._undo("loss", view)
            self._drop_unsound()
            return
        torch.autograd.backward(loss)
        gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
        self._optimiser.step(shown.visible, gradients)
        self._step_medium(view)
        if refine_poses and viewmat.grad is not None and view is not self.views[0]:
            refine_pose(view, viewmat.grad, self.config.optimiser.poses)
        self.steps += 1
        if self.steps % self.config.optimiser.prune_every == 0:
            self._prune(shown, view)

    def _is_optimised(self, name: str) -> bool:
        """Places and opacities always are; beside residuals, the rest only if so configured."""
        frozen = self.neural is not None and not self.config.decoder.optimise_initial
        return not (frozen and name in DECODED)

    def _step_medium(self, view: View) -> None:
        if not self.medium.active:
            return
        norm = torch.nn.utils.clip_grad_norm_(
            self.medium.parameters(), self.config.medium.max_gradient
        )
        if not is_number(norm):
            self._undo("medium gradient", view)
            return
        self._medium_optimiser.step()

    def _undo(self, what: str, view: View) -> None:
        self.undone += 1
        log.warning("non-finite %s on frame %d: step undone", what, view.frame_index)

    def _prune(self, shown: Shown, view: View) -> None:
        """Drop Gaussians that are all but transparent, or that fill the picture."""
        opaque = self.gaussians.opacities > self.config.optimiser.prune_opacity
        widest = self.config.optimiser.prune_radius_widths * view.camera.width
        keep = opaque & (shown.radius_px < widest)
        self._keep(keep)

    def _drop_unsound(self) -> None:
        """Drop Gaussians that are not finite: the scale loss of one would spoil every step."""
        sound = torch.isfinite(self.gaussians.scales.prod(dim=-1))
        for tensor in self._parameters.values():
            sound &= torch.isfinite(tensor).all(dim=-1)
        self._keep(sound)

    def make_whole(self) -> None:
        """After a failure: every row of the optimisers and groups belongs to a Gaussian, and all
        Gaussians are finite."""
        if self.neural is not None:
            self.neural.make_whole()
        if len(self._optimiser.steps) != len(self.gaussians):
            self._optimiser = self._new_optimiser()
        self._optimiser.bind(self._parameters)
        self._drop_unsound()

    def _keep(
        self,
        keep: Tensor,  # [N] bool
    ) -> None:
        """Drop the Gaussians where ``keep`` [N] is False, their optimiser state with them."""
        if not bool(keep.all()):
            (self.neural or self.gaussians).keep(keep)
            self._optimiser.keep(keep)
            self._optimiser.bind(self._parameters)

    # --- looking ------------------------------------------------------------------------------

    def show(self, view: View) -> Shown:
        """The map from ``view``."""
        return self.scene.show(view)

    def register(self, view: View) -> None:
        """Refine the pose of a held-out view photometrically against the frozen map."""
        register(view, self.scene, in_time(self.views), self._objective, self.config.optimiser)

    @property
    def neural(self) -> NeuralGaussians | None:
        """The scene's decoder; None without one."""
        return self.scene.neural

    @property
    def gaussians(self) -> GaussianMap:
        """The scene's Gaussians."""
        return self.scene.gaussians

    @property
    def medium(self) -> Medium:
        """The scene's medium."""
        return self.scene.medium

    @property
    def _parameters(self) -> dict[str, Tensor]:
        return self.gaussians.parameters
