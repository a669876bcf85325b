"""The Local Gaussian Parameter Decoder, LGPD (paper, Eq. 8 to 11).

A token is made of a Gaussian's own feature and its group's; tokens of a group attend to each
other; a geometry head and a colour head, conditioned on the camera's observation o, give what is
added to its initial rotation, log-scale and colour. Place and opacity are not decoded.

The paper adds gamma(o) to the tokens before the attention, which then has to be computed for every
view (``observation: before_attention``). The first layer of the heads is linear in [z, gamma(o)],
so by default gamma(o) enters there: what does not depend on the view, :class:`Trunk`, is computed
once for all views of a step, and is exact for each.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aquaflow.config.mapping import DecoderConfig
from aquaflow.mapping.gaussians import quaternion_product
from aquaflow.mapping.neural.voxel_groups import EMPTY, VoxelGroups
from aquaflow.render.decoding import ViewWeights, decode_view, takes
from aquaflow.render.library import library_or_none
from aquaflow.render.limits import NEAR_PLANE_M
from aquaflow.render.transfers import groups_in, groups_out
from aquaflow.render.views import View
from aquaflow.render.water import BANDS, sinusoidal_encoding

LARGEST_FEATURE = 1e4
"""A feature beyond this, or no number, is unsound: its group is decoded to no residual."""

MASKED = -1e9
"""Added to the score of padding: its weight is exactly zero."""

TURN, LOG_SCALE, COLOUR = 3, 3, 3
"""Widths of the residuals, in this order."""


@dataclass(frozen=True)
class Trunk:
    """The decoder's result up to the first layer of the heads: what all views share, unless the
    observation entered before the attention."""

    tokens: Tokens
    hidden: Tensor
    """[P, d] first layer of both heads, the view's part not yet added."""
    sound: Tensor | None
    """[P] bool: all features of the token's group are sensible numbers; None: of every group."""


class Decoder(nn.Module):
    """LGPD, or an MLP of as many weights that sees no neighbours (the paper's "w/o LGPD").

    The last layers start at zero, so that a new Gaussian starts exactly at its initial state.
    """

    limits: Tensor

    def __init__(self, config: DecoderConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.config, d = config, config.width
        self.local = _linear(config.local_width, d, generator)
        self.shared = _linear(config.global_width, d, generator, bias=False)
        self.mixer = (
            GroupAttention(d, generator) if config.variant == "lgpd" else TokenMlp(d, generator)
        )
        self.first = _linear(d, d, generator)
        self.view = _linear(encoded_width(config.distance), d, generator, bias=False)
        self.geometry = _zero_linear(d // 2, TURN + LOG_SCALE)
        self.colour = _zero_linear(d // 2, COLOUR)
        largest = [config.max_turn, config.max_log_scale, config.max_colour]
        limits = torch.tensor(largest).repeat_interleave(torch.tensor([TURN, LOG_SCALE, COLOUR]))
        self.register_buffer("limits", limits, persistent=False)

    def trunk(
        self,
        tokens: Tokens,
        local: Tensor,  # [N, F_l] feature of each Gaussian
        shared: Tensor,  # [G, F_g] feature of each group
        o: Tensor | None = None,  # [P, 4] observation in each place
    ) -> Trunk:
        """Up to the first layer of the heads; with ``o``, the observation is in the tokens."""
        local = local.index_select(0, tokens.rows)
        shared = shared.index_select(0, tokens.groups)
        sizes, counts = tokens.sizes, [count for count, _ in tokens.buckets]
        sound = None
        if not _all_sound(local, shared):
            per_group = _sound_groups(tokens, local, shared)
            sound = per_group.repeat_interleave(tokens.places_of_groups)
            local = torch.where(sound[:, None], local, 0.0)
            shared = torch.where(per_group[:, None], shared, 0.0)
        own, common = self.local(local), self.shared(shared)
        if o is not None:
            own = own + self.view(encoded_observation(o, self.config.distance))
        mixed = []
        for (count, width), e, g, valid in zip(
            tokens.buckets,
            own.split_with_sizes(sizes),
            common.split_with_sizes(counts),
            tokens.valid.split_with_sizes(sizes),
            strict=True,
        ):
            together = e.view(count, width, -1) + g[:, None]
            mixed.append(self.mixer(together, valid.view(count, width)).reshape(e.shape))
        z = torch.cat(mixed) if mixed else own
        return Trunk(tokens, self.first(z), sound)

    @property
    def observes_first(self) -> bool:
        """True if the trunk takes the observation."""
        return self.config.observation == "before_attention"

    def weight_in_heads(self) -> Tensor:
        """[d, E] of gamma(o) in the heads; zeros where the trunk has the observation."""
        weight: Tensor = self.view.weight
        return torch.zeros_like(weight) if self.observes_first else weight

    def residuals(
        self,
        trunk: Trunk,
        places: Tensor,  # [V] int64 places of trunk.tokens
        o: Tensor,  # [V, 4] observation of the Gaussian in each
    ) -> Tensor:
        """[V, 9]: quaternion vector, log-scales, raw colour; each within its stated limit.

        Zeros for a group with a feature that is no number, and for such an observation.
        """
        encoded = encoded_observation(o, self.config.distance)
        view_part = F.linear(encoded, self.weight_in_heads())
        hidden = torch.relu(trunk.hidden.index_select(0, places) + view_part)
        half = self.config.width // 2  # one product for both heads, each sees its own half
        heads = torch.cat(
            [F.pad(self.geometry.weight, (0, half)), F.pad(self.colour.weight, (half, 0))]
        )
        raw = F.linear(hidden, heads, torch.cat([self.geometry.bias, self.colour.bias]))
        residuals = torch.tanh(raw) * self.limits
        seen = is_sound(o)
        sound = seen if trunk.sound is None else seen & trunk.sound[places]
        return residuals * sound[:, None]


class GroupAttention(nn.Module):
    """Masked self-attention within each group, one head, added to the tokens.

    The tokens are their own keys, and values are already projected for the output: with one head
    of full width, W_k and W_o would only multiply W_q and W_v.
    """

    def __init__(self, width: int, generator: torch.Generator) -> None:
        super().__init__()
        self.query = _linear(width, width, generator, bias=False)
        self.value = _linear(width, width, generator, bias=False)

    def forward(
        self,
        e: Tensor,  # [B, T, d]
        valid: Tensor,  # [B, T] bool
    ) -> Tensor:
        """[B, T, d]"""
        mask = torch.where(valid, 0.0, MASKED).to(e.dtype)[:, None]
        # Two products and a softmax: the backward of torch's fused attention is slower on a CPU.
        scores = torch.baddbmm(mask, self.query(e), e.mT, alpha=1.0 / math.sqrt(e.shape[-1]))
        return torch.baddbmm(e, torch.softmax(scores, dim=-1), self.value(e))


class TokenMlp(nn.Module):
    """Replacement of attention in the ablation: as many weights, each token on its own."""

    def __init__(self, width: int, generator: torch.Generator) -> None:
        super().__init__()
        self.inner = _linear(width, width, generator, bias=False)
        self.outer = _linear(width, width, generator, bias=False)

    def forward(
        self,
        e: Tensor,  # [B, T, d]
        valid: Tensor,  # [B, T] bool
    ) -> Tensor:
        """[B, T, d]"""
        del valid  # no token looks at another
        return e + self.outer(torch.relu(self.inner(e)))  # type: ignore[no-any-return]


def apply_residuals(
    parameters: Mapping[str, Tensor],  # of a GaussianMap
    rows: Tensor,  # [V] int64, each once
    residuals: Tensor,  # [V, 9]
) -> dict[str, Tensor]:
    """The parameters with the residuals on top; other rows are as they were. Differentiable.

    The residual rotation is a unit quaternion in the Gaussian's own axes, q = q0 (1, u) / |(1, u)|:
    a similarity that moves q0 (loop closure) carries it along, and |q| = |q0|.
    """
    u, log_scales, colours = residuals.split_with_sizes([TURN, LOG_SCALE, COLOUR], dim=1)
    turn = F.normalize(F.pad(u, (1, 0), value=1.0), dim=1)
    changed = {
        "quats": quaternion_product(parameters["quats"].index_select(0, rows), turn),
        "log_scales": parameters["log_scales"].index_select(0, rows) + log_scales,
        "raw_colours": parameters["raw_colours"].index_select(0, rows) + colours,
    }
    whole = {name: parameters[name].index_copy(0, rows, new) for name, new in changed.items()}
    return {**parameters, **whole}


def _all_sound(
    *features: Tensor,  # each [..., F]
) -> bool:
    """Every feature is a number of sensible size."""
    ranges = [torch.aminmax(each.detach()) for each in features if each.numel()]  # NaN if any is
    largest = [torch.maximum(-low, high) for low, high in ranges]
    return not largest or bool((torch.stack(largest) < LARGEST_FEATURE).all())


def _sound_groups(
    tokens: Tokens,
    local: Tensor,  # [P, F_l]
    shared: Tensor,  # [B, F_g]
) -> Tensor:
    """[B] bool: all features of the group are numbers of sensible size."""
    bad = (~(local.detach().abs() < LARGEST_FEATURE)).any(1).long()
    numbers = torch.arange(len(shared), device=shared.device)
    group = numbers.repeat_interleave(tokens.places_of_groups)
    count = torch.zeros_like(numbers).index_add_(0, group, bad)
    return (count == 0) & (shared.detach().abs() < LARGEST_FEATURE).all(1)


def _linear(inputs: int, outputs: int, generator: torch.Generator, bias: bool = True) -> nn.Linear:
    """Weights uniform within 1 / sqrt(inputs), as torch draws them, but from ``generator``."""
    layer = nn.Linear(inputs, outputs, bias)
    for weight in layer.parameters():
        nn.init.uniform_(weight, -1 / math.sqrt(inputs), 1 / math.sqrt(inputs), generator=generator)
    return layer


def _zero_linear(inputs: int, outputs: int) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    for weight in layer.parameters():
        nn.init.zeros_(weight)
    return layer


# --------------------------------------------------------------------------------------------------
# View-dependent attributes of Gaussians: initial attributes plus decoded residuals.
#
# One view at a time goes through the compiled kernel; :func:`decoded_torch` is its definition, the
# fallback, and what knows a camera for each Gaussian.

DECODED = ("quats", "log_scales", "raw_colours")
"""Names of the parameters that get residuals."""

MARGIN = 0.3
"""Share of the picture's size by which a centre may lie outside and still be decoded."""


@torch.no_grad()
def in_picture(
    means: Tensor,  # [N, 3] world
    view: View,
    viewmat: Tensor,  # [4, 4]
) -> Tensor:
    """[N] bool: the Gaussian's centre is in the picture, or not far outside it."""
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
    camera, front = view.camera, z > NEAR_PLANE_M
    z = torch.where(front, z, 1.0)
    half_width, half_height = 0.5 * camera.width, 0.5 * camera.height
    across = (camera.fx * x / z + camera.cx - half_width).abs()
    down = (camera.fy * y / z + camera.cy - half_height).abs()
    reach = 1.0 + 2.0 * MARGIN
    return front & (across < reach * half_width) & (down < reach * half_height)


def decode(
    decoder: Decoder,
    trunk: Trunk,
    parameters: Mapping[str, Tensor],  # of a GaussianMap
    places: Tensor,  # [V] int64 places of trunk.tokens
    centre: Tensor,  # [3] of the camera
    threads: int,
) -> dict[str, Tensor]:
    """The parameters with residuals on those in ``places``; differentiable but for the places."""
    on_cpu = trunk.hidden.device.type == "cpu"
    library = library_or_none() if on_cpu and takes(decoder.config.width) else None
    if library is None:
        return decoded_torch(decoder, trunk, parameters, places, centre)
    if trunk.sound is not None:
        places = places[trunk.sound[places]]
    weights = ViewWeights(
        decoder.weight_in_heads(),
        torch.cat([decoder.geometry.weight, decoder.colour.weight]),
        torch.cat([decoder.geometry.bias, decoder.colour.bias]),
        decoder.limits,
    )
    quats, log_scales, raw_colours = decode_view(
        (parameters["quats"], parameters["log_scales"], parameters["raw_colours"]),
        trunk.hidden,
        weights,
        trunk.tokens.rows[places],
        places,
        parameters["means"],
        centre,
        threads,
        library,
    )
    changed = {"quats": quats, "log_scales": log_scales, "raw_colours": raw_colours}
    return {**parameters, **changed}


def decoded_torch(
    decoder: Decoder,
    trunk: Trunk,
    parameters: Mapping[str, Tensor],  # of a GaussianMap
    places: Tensor,  # [V] int64
    centre: Tensor,  # [3], or [V, 3]
) -> dict[str, Tensor]:
    """Reference implementation of :func:`decode` in torch."""
    rows = trunk.tokens.rows[places]
    o = observation(parameters["means"].detach()[rows], centre)
    return apply_residuals(parameters, rows, decoder.residuals(trunk, places, o))


def without_residuals(
    wanted: Mapping[str, Tensor],  # DECODED [V, ...], as they are to be seen
    residuals: Tensor,  # [V, 9]
) -> dict[str, Tensor]:
    """The initial attributes that residuals turn into ``wanted``."""
    u, log_scales, colours = residuals.split_with_sizes([TURN, LOG_SCALE, 3], dim=1)
    back = F.normalize(F.pad(-u, (1, 0), value=1.0), dim=1)
    return {
        "quats": quaternion_product(wanted["quats"], back),
        "log_scales": wanted["log_scales"] - log_scales,
        "raw_colours": wanted["raw_colours"] - colours,
    }


# --------------------------------------------------------------------------------------------------
# Voxel groups laid out for a decoder: groups of about the same fill side by side.

BUCKET = 4
"""Places in a bucket's groups are a multiple of this; padding is 10 % of the tokens on real maps
(the powers of two: 19 %)."""


@dataclass(frozen=True)
class Tokens:
    """The Gaussians of some groups, one place each, and padding."""

    rows: Tensor
    """[P] int64 Gaussian of each place; padding repeats the group's first one."""
    valid: Tensor
    """[P] bool: not padding."""
    groups: Tensor
    """[B] int64 groups in the order of the places."""
    buckets: tuple[tuple[int, int], ...]
    """(groups, places a group) of each bucket, in the order of the places."""

    @property
    def sizes(self) -> list[int]:
        """Places of each bucket."""
        return [count * width for count, width in self.buckets]

    @property
    def places_of_groups(self) -> Tensor:
        """[B] int64 places of each group."""
        flat = groups_in([number for bucket in self.buckets for number in bucket], self.rows.device)
        counts, widths = flat.reshape(-1, 2).unbind(1)
        return widths.repeat_interleave(counts)

    def places(
        self,
        visible: Tensor,  # [N] bool
    ) -> Tensor:
        """[V] int64 places of the visible Gaussians."""
        return torch.nonzero(self.valid & visible[self.rows])[:, 0]


def visible_tokens(
    groups: VoxelGroups,
    visible: Tensor,  # [N] bool
) -> Tokens:
    """All Gaussians of the groups of which one is visible: its neighbours are its context."""
    seen = torch.zeros(len(groups), dtype=torch.int64, device=groups.device)
    chosen = torch.nonzero(seen.index_add_(0, groups.group, visible.long()))[:, 0]
    units = (groups.fill[chosen] + BUCKET - 1).div(BUCKET, rounding_mode="floor")
    units, order = torch.sort(units, stable=True)
    chosen, buckets = chosen[order], _buckets(groups, units)
    tables = [chosen[:0]]
    members = chosen.split_with_sizes([count for count, _ in buckets])
    for (_, width), each in zip(buckets, members, strict=True):
        tables.append(_table(groups, each, width).reshape(-1))
    table = torch.cat(tables)
    first = groups.table[chosen, 0].repeat_interleave(units * BUCKET, output_size=len(table))
    valid = table != EMPTY
    return Tokens(torch.where(valid, table, first), valid, chosen, buckets)


def _buckets(
    groups: VoxelGroups,
    units: Tensor,  # [B] int64 places of each group, in multiples of BUCKET
) -> tuple[tuple[int, int], ...]:
    """(groups, places a group), of the groups that are laid out; the host has to know."""
    most = -(-groups.table.shape[1] // BUCKET)
    counts = torch.zeros(most + 1, dtype=torch.int64, device=units.device)
    counts.index_add_(0, units, torch.ones_like(units))
    return tuple((n, BUCKET * unit) for unit, n in enumerate(groups_out(counts)) if n > 0)


def _table(
    groups: VoxelGroups,
    members: Tensor,  # [B]
    width: int,
) -> Tensor:
    """[B, width] rows; -1 in free places, of which a bucket may have more than a group has."""
    table = groups.table[members, :width]
    return torch.nn.functional.pad(table, (0, width - table.shape[1]), value=EMPTY)


# --------------------------------------------------------------------------------------------------
# The observation condition o = [v, d]: from where, and how far, a Gaussian is seen.
#
# Paper, Eq. 5 and 6. Gradients stop here: through the highest octave a step of the optimiser would
# move Gaussians and cameras only to change the decoder's input.

FURTHEST = 16.0
"""Distances beyond count as this, in scene scales: sixteen times the usual range, the water is
opaque by then, and the encoding stays bounded."""

NEAREST = 1e-6
"""Distance, in scene scales, below which there is no direction: v is shorter than one."""


def encoded_width(distance: bool) -> int:
    """Numbers that :func:`encoded_observation` gives for each Gaussian."""
    return (4 if distance else 3) * (1 + 2 * BANDS)


@torch.no_grad()
def observation(
    means: Tensor,  # [V, 3] world, map units
    centre: Tensor,  # [3] or [V, 3] world, camera centre
    scene_scale: float = 1.0,
) -> Tensor:
    """[V, 4] unit direction from camera to Gaussian and distance in ``scene_scale`` map units.

    A place that is not finite gives numbers that are not finite; :func:`is_sound` finds them.
    """
    ray = (means - centre) / scene_scale
    d = torch.linalg.vector_norm(ray, dim=-1, keepdim=True)
    return torch.cat([ray / d.clamp_min(NEAREST), d.clamp_max(FURTHEST)], dim=-1)


def is_sound(
    o: Tensor,  # [V, 4]
) -> Tensor:
    """[V] bool: the observation can be encoded."""
    return torch.isfinite(o.sum(dim=-1))


def encoded_observation(
    o: Tensor,  # [V, 4]
    distance: bool = True,
) -> Tensor:
    """[V, 36] gamma(o) with L = 4; [V, 27] of the direction alone without ``distance``.

    Zeros in place of what is not sound.
    """
    known = torch.where(is_sound(o)[:, None], o, 0.0)
    return sinusoidal_encoding(known if distance else known[:, :3])
