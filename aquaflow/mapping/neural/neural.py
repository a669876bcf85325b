"""Neural Gaussians: decoded residuals on explicit Gaussians, and their training (Sec. 3.3.1).

One pass over the voxel groups, the trunk, serves a window of several steps, each on its own view;
of a single step where the observation enters before the attention.
When the window ends, features and weights take their step. Places and opacities, and the initial
attributes if they are not frozen, take theirs at every view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.config.mapping import DecoderConfig
from aquaflow.mapping.gaussians import GaussianMap
from aquaflow.mapping.neural.decoder import (
    DECODED,
    Decoder,
    Tokens,
    Trunk,
    decode,
    decoded_torch,
    in_picture,
    observation,
    visible_tokens,
    without_residuals,
)
from aquaflow.mapping.neural.voxel_groups import EMPTY, VoxelGroups
from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.dense_adam import DenseAdam
from aquaflow.render.transfers import groups_out, weights_in
from aquaflow.render.views import View

OTHER_SIZE = 0.1
"""Relative change of a voxel's size in map units from which on the Gaussians are grouped anew;
judgement: the unit in metres gets better all the time, and each time the features begin to fit
other neighbours."""
FEATURE_RATE = 4e-3
"""Adam rate of the features of Gaussians and of groups (ARTDECO: 4e-3)."""


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
        self._window: DecodedWindow | None = None
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
            window = self._window = DecodedWindow.decode_views(self.field, self._next_views(view))
        seen = window.go_on_to(view)
        return self.field.decode(window.trunk, seen, parameters, viewmat)

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
        return self.field.decode(self._looked[2], seen, parameters, viewmat)

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
    def bake_parameters(
        self,
        centres: Tensor,  # [N, 3] of the camera that each Gaussian is seen from
    ) -> dict[str, Tensor]:
        """All parameters as plain Gaussians, each as its own camera sees it."""
        self.settle()
        return self.field.bake_parameters(centres)

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
        self.field.groups = resize(self.groups, self.gaussians.means, size)
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
            self.field.groups = regroup(self.groups, self.gaussians.means)
        if not whole or len(optimisers.shared.steps) != len(self.groups):
            optimisers.renew_shared()
        if len(optimisers.local.steps) != count:
            optimisers.renew_local()
        optimisers.bind()


# --------------------------------------------------------------------------------------------------
# Voxel groups made anew: after a failure that left their tables half changed, or in voxels of
# another size.


def is_whole(
    groups: VoxelGroups,
    count: int,  # N Gaussians in the map
) -> bool:
    """True if every Gaussian has one place in one group, and all tables agree."""
    group, slot, table = groups.group, groups.slot, groups.table
    if len(group) != count or len(slot) != count:
        return False
    if not len(groups) == len(table) == len(groups.voxel) == len(groups.features):
        return False
    inside = (group >= 0) & (group < len(groups)) & (slot >= 0) & (slot < table.shape[1])
    rows = torch.arange(count, device=groups.device)
    if not bool(inside.all()) or not torch.equal(table[group, slot], rows):
        return False
    taken = (table != EMPTY).sum(1)
    numbers = torch.arange(len(groups), device=groups.device)
    listed = torch.equal(torch.sort(groups.order()).values, numbers)
    return listed and torch.equal(taken, groups.fill) and int(taken.sum()) == count


def regroup(
    groups: VoxelGroups,
    means: Tensor,  # [N, 3] of all Gaussians
) -> VoxelGroups:
    """All Gaussians placed anew; a voxel's first group keeps the feature known of that voxel."""
    new = _place(groups, means, groups.size)
    known: dict[int, Tensor] = {}
    for voxel, feature in zip(groups_out(groups.voxel), groups.features, strict=False):
        known.setdefault(voxel, feature)
    for group, voxel in enumerate(groups_out(new.voxel)):
        feature = known.pop(voxel, None)
        if feature is not None and bool(torch.isfinite(feature).all()):
            new.features[group] = feature
    return new


def resize(
    groups: VoxelGroups,
    means: Tensor,  # [N, 3] of all Gaussians
    size: float,
) -> VoxelGroups:
    """All Gaussians in voxels of ``size`` map units; a new group takes over the feature that its
    first Gaussian's had."""
    new = _place(groups, means, size)
    if len(new):
        new.features.copy_(groups.features[groups.group[new.table[:, 0]]])
    return new


def _place(
    groups: VoxelGroups,
    means: Tensor,  # [N, 3]
    size: float,
) -> VoxelGroups:
    new = VoxelGroups(groups.config, groups.features.shape[1], groups.device)
    new.size = size
    new.insert(means)
    return new


# --------------------------------------------------------------------------------------------------
# Adam of a neural field's features, row by row, and of its decoder's weights.


class FeatureOptimisers:
    """A row of state for each Gaussian and each group; rows come and go with them."""

    def __init__(self, field: NeuralField, betas: tuple[float, float]) -> None:
        self.field, self._betas = field, betas
        self.local = self._new("local", field.local)
        self.shared = self._new("shared", field.shared)
        weights = {"params": field.decoder.parameters(), "lr": field.config.rate}
        self.weights = DenseAdam([weights], betas)
        self.skipped = 0
        """Windows whose weights were not stepped, as a gradient was not finite."""

    def _new(
        self,
        name: str,
        features: Tensor,  # [N, F]
    ) -> SelectiveAdam:
        groups = {name: (features, FEATURE_RATE)}
        return SelectiveAdam(groups, self._betas, threads=self.field.threads)

    def step(self, window: DecodedWindow) -> None:
        """One step with the gradient of the window's views."""
        assert window.local.grad is not None
        assert window.shared.grad is not None
        tokens, device = window.whole.tokens, self.field.device
        rows = torch.zeros(len(window.local), dtype=torch.bool, device=device)
        rows[tokens.rows] = True
        groups = torch.zeros(len(window.shared), dtype=torch.bool, device=device)
        groups[tokens.groups] = True
        self.local.step(rows, {"local": window.local.grad})
        self.shared.step(groups, {"shared": window.shared.grad})
        gradients = [w.grad for w in self.field.decoder.parameters() if w.grad is not None]
        finite = [torch.isfinite(gradient).all() for gradient in gradients]
        if bool(torch.stack(finite).all()):
            self.weights.step()
        else:
            self.skipped += 1
        self.forget_gradients()

    def forget_gradients(self) -> None:
        """Drop what the weights were to learn."""
        self.weights.forget_gradients()

    def slow_down(self, factor: float) -> None:
        """Set the learning rates to this share of the configured ones."""
        config = self.field.config
        self.local.learning_rates["local"] = factor * FEATURE_RATE
        self.shared.learning_rates["shared"] = factor * FEATURE_RATE
        self.weights.rates[0] = factor * config.rate

    def renew_shared(self) -> None:
        """Begin at step 0 with the groups as they are."""
        self.shared = self._new("shared", self.field.shared)

    def renew_local(self) -> None:
        """Begin at step 0 with the Gaussians as they are."""
        self.local = self._new("local", self.field.local)

    def bind(self) -> None:
        """Use the field's features as they are now; new groups begin at step 0."""
        self.shared.extend(len(self.field.groups) - len(self.shared.steps))
        self.shared.bind({"shared": self.field.shared})
        self.local.bind({"local": self.field.local})


# --------------------------------------------------------------------------------------------------
# A window of steps of the optimiser that share one trunk, each on its own view.
#
# The window's gradients meet in the trunk's output; when it ends they go through the trunk at once.


@dataclass
class DecodedWindow:
    """A trunk, and the views that still have to be decoded from it."""

    whole: Trunk
    """From features and weights on."""
    hidden: Tensor
    """[P, d] its output as a leaf; gathers the gradient of the window's views."""
    local: Tensor
    """[N, F_l] leaf."""
    shared: Tensor
    """[G, F_g] leaf."""
    views: list[tuple[View, Tensor]]
    """Each with the Gaussians [N] bool that it shows."""

    @staticmethod
    def decode_views(field: NeuralField, views: Sequence[View]) -> DecodedWindow:
        """The window of ``views``; if the trunk takes an observation, it is the first one's."""
        means = field.gaussians.means
        seen = [in_picture(means, each, each.viewmat()) for each in views]
        local = field.local.detach().requires_grad_()
        shared = field.shared.detach().requires_grad_()
        centre = camera_centre(views[0].viewmat())
        trunk = field.trunk(field.context(seen), centre, (local, shared))
        hidden = trunk.hidden.detach().requires_grad_()
        return DecodedWindow(trunk, hidden, local, shared, list(zip(views, seen, strict=True)))

    def has(self, view: View) -> bool:
        """True if ``view`` still has to be decoded."""
        return any(each is view for each, _ in self.views)

    def go_on_to(self, view: View) -> Tensor:
        """[N] bool: what ``view`` shows; steps that were left out before it are passed over."""
        while self.views[0][0] is not view:
            self.views.pop(0)
        return self.views.pop(0)[1]

    @property
    def trunk(self) -> Trunk:
        """What a view is decoded from: its gradient ends in ``hidden``."""
        return Trunk(self.whole.tokens, self.hidden, self.whole.sound)

    def differentiate(self) -> bool:
        """Let the gradient of ``hidden`` reach features and weights; False if there is none."""
        if self.hidden.grad is None:
            return False
        torch.autograd.backward(self.whole.hidden, self.hidden.grad)
        return True


# --------------------------------------------------------------------------------------------------
# Groups, features and decoder of one sub-map: what is decoded, and not how it is learned.


class NeuralField:
    """f_l of each Gaussian, f_g of each voxel group, and LGPD, which decodes them."""

    def __init__(
        self,
        config: DecoderConfig,
        gaussians: GaussianMap,
        generator: torch.Generator,
        threads: int,
    ) -> None:
        self.config, self.gaussians, self.threads = config, gaussians, threads
        self.device = gaussians.device
        size = (len(gaussians), config.local_width)
        gaussians.local_features = torch.zeros(size, device=self.device)
        self.groups = VoxelGroups(config.voxels, config.global_width, self.device)
        self.decoder = weights_in(Decoder(config, generator), self.device)

    @property
    def local(self) -> Tensor:
        """[N, F_l] feature of each Gaussian."""
        return self.gaussians.local_features

    @property
    def shared(self) -> Tensor:
        """[G, F_g] feature of each group."""
        return self.groups.features

    def context(
        self,
        seen: Sequence[Tensor],  # each [N] bool
    ) -> Tensor:
        """[N] bool: what a trunk is made of, for views that show ``seen``."""
        if not self.config.visible_groups:
            return self.everyone()
        return torch.stack(list(seen)).any(dim=0)

    def everyone(self) -> Tensor:
        """[N] bool, all True."""
        return torch.ones(len(self.gaussians), dtype=torch.bool, device=self.device)

    def trunk(
        self,
        seen: Tensor,  # [N] bool
        centres: Tensor,  # [3] or [N, 3] of the cameras
        features: tuple[Tensor, Tensor] | None = None,  # [N, F_l] and [G, F_g]
    ) -> Trunk:
        """The trunk of the groups with a Gaussian in ``seen``; of ``features``, if given, in place
        of the field's own."""
        tokens = visible_tokens(self.groups, seen)
        local, shared = features or (self.local, self.shared)
        return self.decoder.trunk(tokens, local, shared, self._observation(tokens, centres))

    def decode(
        self,
        trunk: Trunk,
        seen: Tensor,  # [N] bool
        parameters: Mapping[str, Tensor],  # of a GaussianMap
        viewmat: Tensor,  # [4, 4]
    ) -> dict[str, Tensor]:
        """The parameters as the camera of ``viewmat`` sees them; differentiable."""
        centre, places = camera_centre(viewmat), trunk.tokens.places(seen)
        return decode(self.decoder, trunk, parameters, places, centre, self.threads)

    @torch.no_grad()
    def bake_parameters(
        self,
        centres: Tensor,  # [N, 3] of the camera that each Gaussian is seen from
    ) -> dict[str, Tensor]:
        """All parameters as plain Gaussians, each as its own camera sees it."""
        everyone = self.everyone()
        trunk = self.trunk(everyone, centres)
        places = trunk.tokens.places(everyone)
        rows = trunk.tokens.rows[places]
        return decoded_torch(self.decoder, trunk, self.gaussians.parameters, places, centres[rows])

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


def camera_centre(
    viewmat: Tensor,  # [4, 4] world to camera
) -> Tensor:
    """[3] world; no gradient."""
    viewmat = viewmat.detach()
    return -viewmat[:3, :3].T @ viewmat[:3, 3]
