"""L_total = L_conf + beta L_match (paper, Eq. 2): where the points are, and which pixels match.

Both terms let the network predict its confidence: an error counts by its confidence, and the
logarithm of the confidence is rewarded. Definitions and weights that the paper leaves out are those
that MASt3R's authors publish for their training.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pairs import Pair, correspondences, nearest_pixels, true_pointmaps


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms; defaults of fine-tuning (docs/paper.md#published-values)."""

    beta: float = 0.075
    """Of the matching term; from scratch it must dominate
    (notes/2026-11-priors.md#compact-prior)."""
    points_alpha: float = 0.2
    """Reward of the logarithm of the points' confidence."""
    match_alpha: float = 10.0
    """Reward of the logarithm of the descriptors' confidence."""
    temperature: float = 0.05
    """Of InfoNCE: unit descriptors' products are divided by it."""
    matches: int = 4096
    """Correspondences drawn from a pair; each is negative to all others."""


class Geometry(Protocol):
    """What a network says of one view; see mast3r.network.ViewGeometry."""

    @property
    def X(self) -> Tensor:
        """Pointmap [..., 3]."""
        ...

    @property
    def Q(self) -> Tensor:
        """Confidence of the points."""
        ...

    @property
    def D(self) -> Tensor:
        """Descriptors [..., d]."""
        ...

    @property
    def C(self) -> Tensor: ...


@dataclass(frozen=True)
class Losses:
    """The terms of one batch."""

    points: Tensor
    match: Tensor
    total: Tensor


def pair_loss(
    pair: Pair, a: Geometry, b: Geometry, weights: LossWeights, generator: torch.Generator
) -> Losses:
    """The paper's objective; scale is not normalised away where the truth is metric."""
    X_a, X_b = true_pointmaps(pair)
    alpha = weights.points_alpha
    points = points_loss(a.X, a.Q, X_a, pair.a.valid, alpha)
    points = points + points_loss(b.X, b.Q, X_b, pair.b.valid, alpha)
    match = match_loss(pair, a, b, weights, generator)
    return Losses(points, match, points + weights.beta * match)


def points_loss(
    X: Tensor,  # [B, H, W, 3]
    Q: Tensor,  # [B, H, W] above 0
    truth: Tensor,  # [B, H, W, 3]
    valid: Tensor,  # [B, H, W] bool
    alpha: float,
) -> Tensor:
    """L_conf: mean of Q |X - truth| - alpha log Q over the valid pixels; zero where none is."""
    error = torch.linalg.vector_norm(X - torch.where(valid[..., None], truth, X.detach()), dim=-1)
    return _mean(Q * error - alpha * Q.log(), valid)


def match_loss(
    pair: Pair, a: Geometry, b: Geometry, weights: LossWeights, generator: torch.Generator
) -> Tensor:
    """L_match: InfoNCE both ways over true matches, weighted by the mean of both confidences."""
    reciprocal, rows, columns = reciprocal_matches(pair)
    losses = []
    for item in range(len(rows)):
        places = _draw(reciprocal[item], weights.matches, generator)
        if len(places) < 2:  # nothing to distinguish
            continue
        v, u = places.unbind(1)
        v_b, u_b = rows[item, v, u], columns[item, v, u]
        trust = (a.C[item, v, u] + b.C[item, v_b, u_b]) / 2
        losses.append(
            info_nce(
                a.D[item, v, u],
                b.D[item, v_b, u_b],
                trust,
                weights.temperature,
                weights.match_alpha,
            )
        )
    return torch.stack(losses).mean() if losses else a.D.sum() * 0.0


def reciprocal_matches(pair: Pair) -> tuple[Tensor, Tensor, Tensor]:
    """[B, H, W] bool, row and column: a's pixels whose match in b has them for its own match.

    No pixel of b is then the match of two of a, which would be each other's negatives.
    """
    there, back = correspondences(pair), correspondences(pair.swap())
    rows, columns = nearest_pixels(there.pixels, pair.b)
    rows_back, columns_back = nearest_pixels(back.pixels, pair.a)
    batch, v, u = (
        torch.arange(n, device=rows.device).view([-1 if i == axis else 1 for i in range(3)])
        for axis, n in enumerate(rows.shape)
    )
    at = (batch, rows, columns)
    same = (rows_back[at] == v) & (columns_back[at] == u) & back.visible[at]
    return there.visible & same, rows, columns


def info_nce(
    D_a: Tensor,  # [M, d] unit descriptors
    D_b: Tensor,  # [M, d] of the matches, in the same order
    trust: Tensor,  # [M] above 0
    temperature: float,
    alpha: float,
) -> Tensor:
    """Mean of trust * (cross-entropies of both ways) - alpha log trust: each must find its match
    among all."""
    scores = D_a @ D_b.mT / temperature
    own = torch.arange(len(scores), device=scores.device)
    both = [F.cross_entropy(s, own, reduction="none") for s in (scores, scores.mT)]
    return (trust * (both[0] + both[1]) - alpha * trust.log()).mean()


def _draw(
    visible: Tensor,  # [H, W] bool
    count: int,
    generator: torch.Generator,
) -> Tensor:
    """[M, 2] row and column of at most ``count`` of the visible pixels, each once."""
    places = torch.nonzero(visible)
    order = torch.randperm(len(places), generator=generator)[:count]
    return places[order.to(places.device)]


def _mean(
    values: Tensor,  # [...]
    valid: Tensor,  # [...] bool
) -> Tensor:
    return torch.where(valid, values, 0.0).sum() / valid.sum().clamp_min(1)
