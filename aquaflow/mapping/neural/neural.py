"""Neural Gaussians: decoded residuals on explicit Gaussians, and their training (Sec. 3.3.1).

One pass over the voxel groups, the trunk, serves a window of several steps, each on its own view;
of a single step where the observation enters before the attention.
When the window ends, features and weights take their step. Places and opacities, and the initial
attributes if they are not frozen, take theirs at every view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from aquaflow.config.mapping import DecoderConfig
from aquaflow.mapping.gaussians.gaussians import GaussianMap
from aquaflow.mapping.neural.decode import DECODED, in_picture, without_residuals
from aquaflow.mapping.neural.decoder import Decoder, Trunk
from aquaflow.mapping.neural.feature_optimisers import FeatureOptimisers
from aquaflow.mapping.neural.neural_field import NeuralField, camera_centre
from aquaflow.mapping.neural.observation import observation
from aquaflow.mapping.neural.regrouping import is_whole, regrouped, resized
from aquaflow.mapping.neural.voxel_groups import VoxelGroups
from aquaflow.mapping.neural.window import Window
from aquaflow.render.views import View

OTHER_SIZE = 0.1
"""Relative change of a voxel's size in map units from which on the Gaussians are grouped anew;
judgement: the unit in metres gets better all the time, and each time the features begin to fit
other neighbours."""


class NeuralGaussians:
    """The neural field of one sub-map, with its optimisers: learns, is looked at, and grows."""

    def __init__(
        self,
        config: DecoderConfig,
        gaussians: GaussianMap,
        betas: tuple[float, float],
        generator: torch.Generator,
        threads: int,
    ) -> None:
        self.config, self.gaussians, self.device = config, gaussians, gaussians.device
        self.field = NeuralField(config, gaussians, generator, threads)
        self.optimisers = FeatureOptimisers(self.field, betas)
        self._expected: list[View] = []
        self._window: Window | None = None
        self._looked: tuple[View, Tensor, Trunk] | None = None
        """View, camera centre and trunk of ``seen_from``'s last look, while nothing has changed."""

    @property
    def groups(self) -> VoxelGroups:
        """The voxel groups, with the feature of each."""
        return self.field.groups

    @property
    def decoder(self) -> Decoder:
        """LGPD."""
        return self.field.decoder

    # --- learning -----------------------------------------------------------------------------

    def expect(self, views: Sequence[View]) -> None:
        """The views of the next steps, in their order."""
        self.settle()
        self._expected = list(views)

    def decode(
        self,
        view: View,
        parameters: Mapping[str, Tensor],  # of the GaussianMap
        viewmat: Tensor,  # [4, 4]
    ) -> dict[str, Tensor]:
        """The parameters as seen from ``view``, for a step of the optimiser; differentiable."""
        window = self._window
        if window is None or not window.has(view):
            self.settle()
            window = self._window = Window.opened(self.field, self._next_views(view))
        seen = window.go_on_to(view)
        return self.field.decoded(window.trunk, seen, parameters, viewmat)

    def settle(self) -> None:
        """End the window: one optimiser step of features and weights with its views' gradient."""
        self._looked, window, self._window = None, self._window, None
        if window is None:
            return
        self._expected = [view for view, _ in window.views] + self._expected
        if window.differentiate():
            self.optimisers.step(window)

    def slow_down(self, factor: float) -> None:
        """Set the learning rates to this share of the configured ones."""
        self.optimisers.slow_down(factor)

    def _next_views(self, view: View) -> list[View]:
        """``view`` and those expected after it, as many as share a trunk."""
        if view not in self._expected:
            return [view]
        begin = self._expected.index(view)  # what is before it was left out
        most = 1 if self.decoder.observes_first else self.config.views_per_trunk
        views = self._expected[begin : begin + most]
        del self._expected[: begin + len(views)]
        return views

    # --- looking ------------------------------------------------------------------------------

    @torch.no_grad()
    def seen_from(
        self,
        view: View,
        viewmat: Tensor,  # [4, 4]
    ) -> dict[str, Tensor]:
        """The parameters as seen from ``view``; no gradient.

        The trunk is kept for further looks from the same view, until something changes.
        """
        parameters, centre = self.gaussians.parameters, camera_centre(viewmat)
        seen = in_picture(parameters["means"], view, viewmat)
        if not self._looks_again(view, centre):
            self.settle()
            self._looked = (view, centre, self.field.trunk(self.field.context([seen]), centre))
        assert self._looked is not None
        return self.field.decoded(self._looked[2], seen, parameters, viewmat)

    def _looks_again(
        self,
        view: View,
        centre: Tensor,  # [3]
    ) -> bool:
        """True if the last look's trunk holds for this one: a pose that is being refined moves."""
        if self._window is not None or self._looked is None or self._looked[0] is not view:
            return False
        return not self.decoder.observes_first or torch.equal(self._looked[1], centre)

    @torch.no_grad()
    def baked(
        self,
        centres: Tensor,  # [N, 3] of the camera that each Gaussian is seen from
    ) -> dict[str, Tensor]:
        """All parameters as plain Gaussians, each as its own camera sees it."""
        self.settle()
        return self.field.baked(centres)

    # --- growing and following ----------------------------------------------------------------

    @torch.no_grad()
    def insert(
        self,
        centres: Tensor,  # [3] or [M, 3] of the camera that the new Gaussians are seen from
        count: int,  # M
    ) -> None:
        """Group the map's last ``count`` Gaussians, and change their initial attributes so that
        the decoded ones, seen from ``centres``, are those given."""
        if count == 0:
            return
        self.settle()
        self.groups.insert(self.gaussians.means[-count:])
        self.optimisers.local.extend(count)
        self.optimisers.bind()
        rows = torch.zeros(len(self.gaussians), dtype=torch.bool, device=self.device)
        rows[-count:] = True
        trunk = self.field.trunk(rows, self._with_neighbours(centres, count))
        places = trunk.tokens.places(rows)
        new, first = trunk.tokens.rows[places], len(rows) - count
        parameters = self.gaussians.parameters
        centre = centres if centres.dim() == 1 else centres[new - first]
        residuals = self.decoder.residuals(
            trunk, places, observation(parameters["means"][new], centre)
        )
        initial = without_residuals({name: parameters[name][new] for name in DECODED}, residuals)
        for name, values in initial.items():
            parameters[name][new] = values

    def _with_neighbours(
        self,
        centres: Tensor,  # [3] or [M, 3]
        count: int,  # M
    ) -> Tensor:
        """[3] or [N, 3]: the older Gaussians as seen from amid the cameras of the new ones."""
        if centres.dim() == 1:
            return centres
        older = centres.mean(dim=0).expand(len(self.gaussians) - count, 3)
        return torch.cat([older, centres])

    @torch.no_grad()
    def keep(
        self,
        mask: Tensor,  # [N] bool
    ) -> None:
        """Drop the Gaussians where ``mask`` is False, from the map too."""
        self.settle()
        self.gaussians.keep(mask)
        self.groups.keep(mask)
        self.optimisers.local.keep(mask)
        self.optimisers.shared.keep(self.groups.compact())
        self.optimisers.bind()

    @torch.no_grad()
    def move(
        self,
        rows: Tensor,  # [M] int64 of the Gaussians that were moved
    ) -> None:
        """Follow a loop closure."""
        self.settle()
        if len(rows):
            self.groups.move(rows, self.gaussians.means)
            self.optimisers.bind()

    @torch.no_grad()
    def use_unit(self, metres_per_unit: float) -> None:
        """Once the map's unit is known: voxels of the configured size in metres, if any."""
        size_m = self.config.voxels.size_m
        size = self.groups.size if size_m is None else size_m / metres_per_unit
        if abs(size / self.groups.size - 1.0) <= OTHER_SIZE:
            return
        self.settle()
        self.field.groups = resized(self.groups, self.gaussians.means, size)
        self.optimisers.renew_shared()
        self.optimisers.bind()

    def restore(
        self,
        local: Tensor,  # [N, F_l]
    ) -> None:
        """Use restored local features and groups, with optimisers at step 0."""
        self.gaussians.local_features = local
        self.optimisers.local.extend(len(local) - len(self.optimisers.local.steps))
        self.optimisers.bind()

    def make_whole(self) -> None:
        """After a failure: each Gaussian has its place in a group, each row its optimiser state.

        The window that was open is given up: what its views asked for is not learned.
        """
        self._looked = self._window = None
        optimisers, count = self.optimisers, len(self.gaussians)
        optimisers.forget_gradients()
        whole = is_whole(self.groups, count)
        if not whole:
            self.field.groups = regrouped(self.groups, self.gaussians.means)
        if not whole or len(optimisers.shared.steps) != len(self.groups):
            optimisers.renew_shared()
        if len(optimisers.local.steps) != count:
            optimisers.renew_local()
        optimisers.bind()
