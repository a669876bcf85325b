"""Neural Gaussians: decoded residuals on explicit Gaussians, and their training (Sec. 3.3.1).

One pass over the voxel groups, the trunk, serves a window of several steps, each on its own view;
of a single step where the observation enters before the attention.
The window's gradients meet in the trunk's output; when it ends they go through the trunk at once,
and features and weights take their step. Places and opacities, and the initial attributes if they
are not frozen, take theirs at every view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.config.mapping import DecoderConfig
from aquaflow.mapping.decoder.decode import (
    DECODED,
    decoded,
    decoded_torch,
    in_picture,
    without_residuals,
)
from aquaflow.mapping.decoder.decoder import Decoder, Trunk
from aquaflow.mapping.decoder.observation import observation
from aquaflow.mapping.decoder.regrouping import is_whole, regrouped, resized
from aquaflow.mapping.decoder.tokens import Tokens, visible_tokens
from aquaflow.mapping.decoder.voxel_groups import VoxelGroups
from aquaflow.mapping.gaussians.gaussians import GaussianMap
from aquaflow.mapping.transfers import weights_in
from aquaflow.mapping.views import View
from aquaflow.render.adam import SelectiveAdam

OTHER_SIZE = 0.1
"""Relative change of a voxel's size in map units from which on the Gaussians are grouped anew;
judgement: the unit in metres gets better all the time, and each time the features begin to fit
other neighbours."""


@dataclass
class Window:
    """A trunk, and the views that still have to be decoded from it."""

    trunk: Trunk
    hidden: Tensor
    """[P, d] the trunk's output as a leaf; gathers the gradient of the window's views."""
    local: Tensor
    """[N, F_l] leaf."""
    shared: Tensor
    """[G, F_g] leaf."""
    views: list[tuple[View, Tensor]]
    """Each with the Gaussians [N] bool that it shows."""


class NeuralGaussians:
    """Groups, features and decoder of one sub-map, with their optimisers."""

    def __init__(
        self,
        config: DecoderConfig,
        gaussians: GaussianMap,
        betas: tuple[float, float],
        generator: torch.Generator,
        threads: int,
    ) -> None:
        self.config, self.gaussians, self.threads = config, gaussians, threads
        self.device = gaussians.device
        size = (len(gaussians), config.local_width)
        gaussians.local_features = torch.zeros(size, device=self.device)
        self.groups = VoxelGroups(config.voxels, config.global_width, self.device)
        self.decoder = weights_in(Decoder(config, generator), self.device)
        self._betas = betas
        self._local = self._feature_optimiser("local", gaussians.local_features)
        self._shared = self._feature_optimiser("shared", self.groups.features)
        self._weights = torch.optim.Adam(self.decoder.parameters(), lr=config.rate, betas=betas)
        self._expected: list[View] = []
        self._window: Window | None = None
        self._looked: tuple[View, Tensor, Trunk] | None = None
        """View, camera centre and trunk of ``seen_from``'s last look, while nothing has changed."""
        self.skipped = 0
        """Windows whose weights were not stepped, as a gradient was not finite."""

    def _feature_optimiser(
        self,
        name: str,
        features: Tensor,  # [N, F]
    ) -> SelectiveAdam:
        groups = {name: (features, self.config.feature_rate)}
        return SelectiveAdam(groups, self._betas, threads=self.threads)

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
        if window is None or all(each is not view for each, _ in window.views):
            self.settle()
            window = self._window = self._open(view)
        while window.views[0][0] is not view:  # a step that was left out
            window.views.pop(0)
        _, seen = window.views.pop(0)
        trunk = Trunk(window.trunk.tokens, window.hidden, window.trunk.sound)
        return self._decoded(trunk, seen, parameters, viewmat)

    def settle(self) -> None:
        """End the window: one optimiser step of features and weights with its views' gradient."""
        self._looked, window, self._window = None, self._window, None
        if window is None:
            return
        self._expected = [view for view, _ in window.views] + self._expected
        if window.hidden.grad is None:
            return
        torch.autograd.backward(window.trunk.hidden, window.hidden.grad)
        assert window.local.grad is not None
        assert window.shared.grad is not None
        tokens = window.trunk.tokens
        rows = torch.zeros(len(window.local), dtype=torch.bool, device=self.device)
        rows[tokens.rows] = True
        groups = torch.zeros(len(window.shared), dtype=torch.bool, device=self.device)
        groups[tokens.groups] = True
        self._local.step(rows, {"local": window.local.grad})
        self._shared.step(groups, {"shared": window.shared.grad})
        gradients = [w.grad for w in self.decoder.parameters() if w.grad is not None]
        if all(bool(torch.isfinite(gradient).all()) for gradient in gradients):
            self._weights.step()
        else:
            self.skipped += 1
        self._weights.zero_grad(set_to_none=True)

    def slow_down(self, factor: float) -> None:
        """Set the learning rates to this share of the configured ones."""
        self._local.learning_rates["local"] = factor * self.config.feature_rate
        self._shared.learning_rates["shared"] = factor * self.config.feature_rate
        self._weights.param_groups[0]["lr"] = factor * self.config.rate

    def _open(self, view: View) -> Window:
        views = [view]
        if view in self._expected:
            begin = self._expected.index(view)  # what is before it was left out
            most = 1 if self.decoder.observes_first else self.config.views_per_trunk
            views = self._expected[begin : begin + most]
            del self._expected[: begin + len(views)]
        means = self.gaussians.means
        seen = [in_picture(means, each, each.viewmat()) for each in views]
        local = self.gaussians.local_features.detach().requires_grad_()
        shared = self.groups.features.detach().requires_grad_()
        tokens = visible_tokens(self.groups, self._context(seen))
        o = self._observation(tokens, camera_centre(view.viewmat()))
        trunk = self.decoder.trunk(tokens, local, shared, o)
        hidden = trunk.hidden.detach().requires_grad_()
        return Window(trunk, hidden, local, shared, list(zip(views, seen, strict=True)))

    def _context(
        self,
        seen: Sequence[Tensor],  # each [N] bool
    ) -> Tensor:
        """[N] bool: what a trunk is made of, for views that show ``seen`` (each [N] bool)."""
        if not self.config.visible_groups:
            return torch.ones(len(self.gaussians), dtype=torch.bool, device=self.device)
        return torch.stack(list(seen)).any(dim=0)

    def _decoded(
        self,
        trunk: Trunk,
        seen: Tensor,  # [N] bool
        parameters: Mapping[str, Tensor],  # of a GaussianMap
        viewmat: Tensor,  # [4, 4]
    ) -> dict[str, Tensor]:
        centre, places = camera_centre(viewmat), trunk.tokens.places(seen)
        return decoded(self.decoder, trunk, parameters, places, centre, self.threads)

    def _observation(
        self,
        tokens: Tokens,
        centres: Tensor,  # [3], or [N, 3] of the camera that each Gaussian is seen from
    ) -> Tensor | None:
        """[P, 4] what the trunk takes; None where the observation enters after the attention."""
        if not self.decoder.observes_first:
            return None
        centre = centres if centres.dim() == 1 else centres[tokens.rows]
        return observation(self.gaussians.means.detach()[tokens.rows], centre)

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
            self._looked = (view, centre, self._trunk(self._context([seen]), centre))
        assert self._looked is not None
        return self._decoded(self._looked[2], seen, parameters, viewmat)

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
        everyone = torch.ones(len(self.gaussians), dtype=torch.bool, device=self.device)
        trunk = self._trunk(everyone, centres)
        places = trunk.tokens.places(everyone)
        rows = trunk.tokens.rows[places]
        return decoded_torch(self.decoder, trunk, self.gaussians.parameters, places, centres[rows])

    def _trunk(
        self,
        seen: Tensor,  # [N] bool
        centres: Tensor,  # [3] or [N, 3] of the cameras
    ) -> Trunk:
        """The trunk of the groups with a visible Gaussian, from the current state."""
        self.settle()
        tokens = visible_tokens(self.groups, seen)
        features = (self.gaussians.local_features, self.groups.features)
        return self.decoder.trunk(tokens, *features, self._observation(tokens, centres))

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
        self._local.extend(count)
        self._bind()
        rows = torch.zeros(len(self.gaussians), dtype=torch.bool, device=self.device)
        rows[-count:] = True
        trunk = self._trunk(rows, self._with_neighbours(centres, count))
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
        self._local.keep(mask)
        self._shared.keep(self.groups.compact())
        self._bind()

    @torch.no_grad()
    def move(
        self,
        rows: Tensor,  # [M] int64 of the Gaussians that were moved
    ) -> None:
        """Follow a loop closure."""
        self.settle()
        if len(rows):
            self.groups.move(rows, self.gaussians.means)
            self._bind()

    @torch.no_grad()
    def use_unit(self, metres_per_unit: float) -> None:
        """Once the map's unit is known: voxels of the configured size in metres, if any."""
        size_m = self.config.voxels.size_m
        size = self.groups.size if size_m is None else size_m / metres_per_unit
        if abs(size / self.groups.size - 1.0) <= OTHER_SIZE:
            return
        self.settle()
        self.groups = resized(self.groups, self.gaussians.means, size)
        self._shared = self._feature_optimiser("shared", self.groups.features)
        self._bind()

    def restore(
        self,
        local: Tensor,  # [N, F_l]
    ) -> None:
        """Use restored local features and groups, with optimisers at step 0."""
        self.gaussians.local_features = local
        self._local.extend(len(local) - len(self._local.steps))
        self._bind()

    def make_whole(self) -> None:
        """After a failure: each Gaussian has its place in a group, each row its optimiser state.

        The window that was open is given up: what its views asked for is not learned.
        """
        self._looked = self._window = None
        self._weights.zero_grad(set_to_none=True)
        count = len(self.gaussians)
        whole = is_whole(self.groups, count)
        if not whole:
            self.groups = regrouped(self.groups, self.gaussians.means)
        if not whole or len(self._shared.steps) != len(self.groups):
            self._shared = self._feature_optimiser("shared", self.groups.features)
        if len(self._local.steps) != count:
            self._local = self._feature_optimiser("local", self.gaussians.local_features)
        self._bind()

    def _bind(self) -> None:
        self._shared.extend(len(self.groups) - len(self._shared.steps))
        self._shared.bind({"shared": self.groups.features})
        self._local.bind({"local": self.gaussians.local_features})


def camera_centre(
    viewmat: Tensor,  # [4, 4] world to camera
) -> Tensor:
    """[3] world; no gradient."""
    viewmat = viewmat.detach()
    return -viewmat[:3, :3].T @ viewmat[:3, 3]
