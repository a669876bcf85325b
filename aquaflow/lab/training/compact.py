"""What the compact prior learns from generated pairs.

The paper's two terms with the weights that learning from scratch wants: InfoNCE over true matches
dominates; ranges are regressed by |error| / b + log b, which is L_conf with Q = 1 / b.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.networks.compact.network import (
    COARSE,
    FINE,
    SHARPEST,
    CompactPrior,
    Encoded,
    cell_rays,
    descriptors_at,
    window_products,
)
from aquaflow.lab.training.compact_range import range_loss
from aquaflow.lab.training.compact_recall import drawn_matches, mean_recall
from aquaflow.lab.training.pair_generator.conditions import Conditions
from aquaflow.lab.training.pair_generator.drawing import WindowVariation, training_pair
from aquaflow.lab.training.pair_generator.map_pairs import MapPairs
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.real_pictures import RealPictures
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD, STRIDE, Pool
from aquaflow.lab.training.pairs import Correspondences, Pair, correspondences, join

CPUINFO = Path("/proc/cpuinfo")
BFLOAT16 = frozenset({"avx512_bf16", "amx_bf16", "bf16"})
"""What processors call that they multiply it, x86-64 and ARM."""


@dataclass(frozen=True)
class CompactSettings:
    """How a batch is drawn, and how the terms weigh."""

    batch: int = 8
    """Pairs of a step."""
    matches: int = 160
    """Fine matches drawn from a pair."""
    reach: int = 3
    """Fine cells on either side of the true cell that the loss separates it from."""
    apart_px: float = 4.0
    """Matches closer than this are not held against each other."""
    first_scenes: int = 160
    """Pairs that are rendered before the first step."""
    steps_per_shard: int = 10
    """Steps after which another shard of pairs joins; none is used before its step, so that a
    run is the same whether its pool existed before or is rendered during the run."""
    scenes: int = 2400
    """Pairs of the whole pool."""
    real_share: float = 0.25
    """Of a batch's pairs, if there are pictures to take them from."""
    map_share: float = 0.25
    """Of a batch's pairs, if there are maps, once they take part; one pair at least."""
    map_pairs: int = 240
    """Of each map."""
    conditions: Conditions = field(default_factory=Conditions)
    calm_steps: int = 2000
    """Steps over which the conditions become as hard as they are meant to be: under hard ones from
    the start, descriptors stay at chance for longer."""
    coarse_weight: float = 0.5
    trust_weight: float = 0.1
    range_weight: float = 0.3


class CompactTask:
    """Batches, loss and validation; a step's batch follows from seed and step alone."""

    def __init__(
        self,
        network: CompactPrior,
        pool: Pool,
        held_out: dict[str, list[Pair]],
        settings: CompactSettings,
        looks_at: Callable[[int], WindowVariation],
        seed: int,
        real: RealPictures | None = None,
        maps: MapPairs | None = None,
        maps_from: int = 0,
    ) -> None:
        """Pairs of ``maps`` take part from step ``maps_from`` on; ``held_out`` by the start of the
        names that their figures have."""
        # A tenth to a fifth faster in bfloat16 where a CPU has it (40 to 48, 47 to 54 ms a pair).
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.network = network
        self.pool, self.held_out = pool, held_out
        self.settings, self.looks_at, self.seed = settings, looks_at, seed
        self.real = real
        self.maps, self.maps_from = maps, maps_from

    @property
    def device(self) -> torch.device:
        """Where the network is; scenes are seen through water there too."""
        return next(self.network.parameters()).device

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """Loss of step number ``step``, and its terms."""
        draw = Draw(self.seed * STRIDE + step, self.device)
        settings = self.settings
        known = settings.first_scenes + step // settings.steps_per_shard * SHARD
        real = 0 if self.real is None else round(settings.real_share * settings.batch)
        maps = self.maps if step >= self.maps_from else None
        mapped = 0 if maps is None else max(round(settings.map_share * settings.batch), 1)
        numbers = draw.whole(settings.batch - real - mapped, below=min(known, settings.scenes))
        parts = [self.pool.pairs(numbers.cpu()).to(self.device)]
        if maps is not None:
            parts.append(maps.pairs(draw, mapped))
        if self.real is not None:
            parts.append(self.real.pairs(draw, real))
        clear = join(parts)
        conditions = settings.conditions.scale(min(step / max(settings.calm_steps, 1), 1.0))
        pair = training_pair(draw, clear, self.looks_at(step), conditions)
        ranged = torch.arange(settings.batch, device=self.device) < settings.batch - real
        terms = compact_losses(self.network, pair, settings, draw, ranged)
        total = (
            settings.coarse_weight * terms["coarse"]
            + terms["among"]
            + terms["around"]
            + settings.trust_weight * terms["trust"]
            + settings.range_weight * terms["range"]
        )
        return total, {name: float(term.detach()) for name, term in terms.items()}

    def validate(self) -> dict[str, float]:
        """Figures on the held-out pairs, see ``recall_of``."""
        self.network.eval()
        figures: dict[str, float] = {}
        for start, held_out in self.held_out.items():
            pairs = [pair.to(self.device) for pair in held_out]
            found = mean_recall(self.network.encode, self.network.comparison, pairs)
            figures |= {f"{start}{name}": value for name, value in found.items()}
        return figures


def compact_losses(
    network: CompactPrior,
    pair: Pair,
    settings: CompactSettings,
    draw: Draw,
    ranged: Tensor | None = None,  # [B] bool, None: all
) -> dict[str, Tensor]:
    """The terms of a batch; ranges are learnt from those that are ``ranged``."""
    images = torch.cat([pair.a.image, pair.b.image])
    with torch.autocast(
        images.device.type, torch.bfloat16, enabled=multiplies_bfloat16(images.device)
    ):
        encoded = network.encode(images)
    a, b = (Encoded(*parts) for parts in zip(*(x.chunk(2) for x in encoded), strict=True))
    found = correspondences(pair)
    size = (pair.a.depth.shape[-2], pair.a.depth.shape[-1])
    coarse = coarse_loss(network.comparison.scores(a.Dc, b.Dc), found, size)
    fine = fine_losses(network, a, b, found, settings, draw)
    nothing = covered_trust(a.C, pair.a.depth, settings.matches // 4, draw)
    fine["trust"] = fine["trust"] + nothing
    rays = [cell_rays(view.K, *size) for view in (pair.a, pair.b)]
    one, other = network.comparison(a.Dc.detach(), b.Dc.detach(), *rays)
    return {"coarse": coarse, **fine, "range": range_loss(pair, one, other, ranged)}


@cache
def multiplies_bfloat16(device: torch.device) -> bool:
    """False where the device would imitate it: a step takes twice as long as in 32 bits there."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    try:
        words = CPUINFO.read_text().split()
    except OSError:
        return False
    return not BFLOAT16.isdisjoint(words)


def coarse_loss(
    scores: Tensor,  # [B, cells of a, cells of b]
    found: Correspondences,
    size: tuple[int, int],
) -> Tensor:
    """InfoNCE over cells, both ways; the truth is spread over the four cells around it."""
    rows, columns = size[0] // COARSE, size[1] // COARSE
    middle = slice(COARSE // 2, None, COARSE)
    # The pixel whose centre is half a pixel beyond the cell's: the match moves back by as much.
    target = found.pixels[:, middle, middle].flatten(1, 2) - 0.5
    visible = found.visible[:, middle, middle].flatten(1)
    place = target / COARSE - 0.5
    low = place.floor()
    share = place - low
    log_p = (torch.log_softmax(scores, 2) + torch.log_softmax(scores, 1)) / 2.0
    loss = torch.zeros_like(visible, dtype=scores.dtype)
    for dx in (0, 1):
        for dy in (0, 1):
            column = (low[..., 0].nan_to_num() + dx).long().clamp(0, columns - 1)
            row = (low[..., 1].nan_to_num() + dy).long().clamp(0, rows - 1)
            weight = (1 - dx + (2 * dx - 1) * share[..., 0]) * (
                1 - dy + (2 * dy - 1) * share[..., 1]
            )
            loss = loss - weight * log_p.gather(2, (row * columns + column)[..., None])[..., 0]
    return torch.where(visible, loss, 0.0).sum() / visible.sum().clamp_min(1)


def fine_losses(
    network: CompactPrior,
    a: Encoded,
    b: Encoded,
    found: Correspondences,
    settings: CompactSettings,
    draw: Draw,
) -> dict[str, Tensor]:
    """``among``: from other matches of the pair; ``around``: from the truth's own surroundings;
    ``trust``: whether C foretells which matches are found."""
    here, there, use = drawn_matches(found, settings.matches, draw)
    D_a, D_b = descriptors_at(a.D, here), descriptors_at(b.D, there)
    sharpness = network.fine_sharpness.clamp_max(SHARPEST).exp()
    scores = D_a @ D_b.mT * sharpness
    own = torch.eye(scores.shape[1], dtype=torch.bool, device=scores.device)
    losses = []
    for side, points in ((scores, there), (scores.mT, here)):
        close = torch.cdist(points, points) < settings.apart_px
        kept = side.masked_fill(close & ~own, -torch.inf)
        losses.append(torch.logsumexp(kept, 2) - side.diagonal(dim1=1, dim2=2))
    among = (losses[0] + losses[1]) / 2.0
    around, at_most = _around(D_a, b.D, there, sharpness, settings.reach)
    best = scores.argmax(2)
    hit = (there - there.gather(1, best[..., None].expand_as(there))).norm(dim=-1)
    hit = (hit < settings.apart_px) & at_most
    trust = _trust_at(a.C, here)
    certain = F.binary_cross_entropy(trust, hit.float(), reduction="none")
    return {
        name: torch.where(use, value, 0.0).sum() / use.sum().clamp_min(1)
        for name, value in (("among", among), ("around", around), ("trust", certain))
    }


def _around(
    D_a: Tensor,  # [B, N, d]
    D_b: Tensor,  # [B, d, h, w]
    there: Tensor,  # [B, N, 2] px
    sharpness: Tensor,  # []
    reach: int,
) -> tuple[Tensor, Tensor]:
    """[B, N] cross-entropy in a window around the truth, and whether its best lies within 2 px."""
    cells, products = window_products(D_a, D_b, there, reach)
    away = (cells + 0.5) * FINE - there[:, :, None]
    truth = (1.0 - away.abs() / FINE).clamp_min(0.0).prod(-1) * (products > -1.0)
    log_p = torch.log_softmax(products * sharpness, 2)
    loss = -(truth * log_p).sum(2)
    best = away.gather(2, products.argmax(2)[..., None, None].expand(-1, -1, 1, 2))[:, :, 0]
    return loss, best.norm(dim=-1) < 2.0


def covered_trust(
    C: Tensor,  # [B, H/2, W/2]
    depth: Tensor,  # [B, H, W]
    count: int,
    draw: Draw,
) -> Tensor:
    """Mean -log(1 - C) where a picture shows open water, text, or what moves on its own."""
    covered = F.max_pool2d(-depth[:, None], FINE)[:, 0] >= 0.0
    weights = covered.flatten(1).float()
    index = torch.multinomial(weights + 1e-9, count, generator=draw.generator)
    use = covered.flatten(1).gather(1, index)
    loss = -torch.log1p(-C.flatten(1).gather(1, index).clamp_max(1.0 - 1e-6))
    return torch.where(use, loss, 0.0).sum() / max(use.numel(), 1)


def _trust_at(
    C: Tensor,  # [B, h, w]
    places: Tensor,  # [B, N, 2] px
) -> Tensor:
    """[B, N]"""
    column, row = (places / FINE).long().unbind(-1)
    return C.flatten(1).gather(1, row * C.shape[2] + column)
