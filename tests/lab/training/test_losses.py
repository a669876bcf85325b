"""The objective of the prior: its optima are where they should be, its gradients are exact."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.losses import (
    LossWeights,
    info_nce,
    match_loss,
    pair_loss,
    points_loss,
    reciprocal_matches,
)
from aquaflow.lab.training.pairs import Pair, correspondences, true_pointmaps
from aquaflow.lab.training.trainer import Schedule
from tests.lab.training.plane_pairs import shifted_pair

pytestmark = pytest.mark.usefixtures("one_thread")


class Said(NamedTuple):
    X: Tensor
    Q: Tensor
    D: Tensor
    C: Tensor


def said(pair: Pair, seed: int = 0) -> tuple[Said, Said]:
    """What a network that knows nothing says."""
    rng = torch.Generator().manual_seed(seed)
    shape = pair.a.depth.shape

    def view() -> Said:
        points = torch.randn(*shape, 3, generator=rng, dtype=torch.float64)
        descriptors = torch.randn(*shape, 4, generator=rng, dtype=torch.float64)
        trust = 1.0 + torch.rand(2, *shape, generator=rng, dtype=torch.float64)
        return Said(points, trust[0], F.normalize(descriptors, dim=-1), trust[1])

    return view(), view()


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_confidence_pays_until_it_is_alpha_over_the_error() -> None:
    truth, valid = torch.zeros(1, 1, 1, 3), torch.ones(1, 1, 1, dtype=torch.bool)
    X = torch.tensor([[[[0.0, 0.4, 0.3]]]])  # half a metre off
    alpha = 0.2
    losses = [
        float(points_loss(X, torch.full((1, 1, 1), Q), truth, valid, alpha))
        for Q in (0.3, alpha / 0.5, 0.5)
    ]
    assert losses[1] < losses[0]
    assert losses[1] < losses[2]


def test_only_pixels_with_truth_count() -> None:
    pair = shifted_pair(0.5)
    a, _ = said(pair)
    truth, _ = true_pointmaps(pair)
    valid = torch.zeros_like(pair.a.valid)
    valid[0, 3, 4] = True
    truth = torch.where(valid[..., None], truth, math.nan)
    loss = points_loss(a.X, a.Q, truth, valid, 0.0)
    expected = a.Q[0, 3, 4] * (a.X - truth)[0, 3, 4].norm()
    assert torch.allclose(loss, expected)
    assert float(points_loss(a.X, a.Q, truth, torch.zeros_like(valid), 0.2)) == 0.0


def test_gradients_of_the_points_term_are_exact() -> None:
    pair = shifted_pair(0.5)
    a, _ = said(pair)
    truth, _ = true_pointmaps(pair)
    X, Q = a.X[:, :2, :2].clone().requires_grad_(), a.Q[:, :2, :2].clone().requires_grad_()
    valid, there = pair.a.valid[:, :2, :2], truth[:, :2, :2]
    torch.autograd.gradcheck(lambda X, Q: points_loss(X, Q, there, valid, 0.2), (X, Q))


def test_info_nce_is_chance_for_equal_descriptors_and_nothing_for_clear_ones() -> None:
    trust = torch.ones(8)
    same = F.normalize(torch.ones(8, 8), dim=-1)
    assert float(info_nce(same, same, trust, 0.05, 10.0)) == pytest.approx(2 * math.log(8))
    assert float(info_nce(torch.eye(8), torch.eye(8), trust, 0.05, 10.0)) < 1e-6


def test_gradients_of_info_nce_are_exact() -> None:
    rng = generator()
    D_a, D_b = torch.randn(2, 5, 3, generator=rng, dtype=torch.float64)
    trust = (torch.rand(5, generator=rng, dtype=torch.float64) + 0.5).requires_grad_()
    inputs = (D_a.requires_grad_(), D_b.requires_grad_(), trust)
    torch.autograd.gradcheck(lambda *x: info_nce(*x, temperature=0.5, alpha=10.0), inputs)


def test_a_match_counts_by_the_mean_of_both_confidences() -> None:
    """As published; the product would let one view alone call a match worthless."""
    pair = shifted_pair(0.5)
    a, b = said(pair)
    sure, unsure = torch.full_like(a.C, 3.0), torch.full_like(a.C, 1.0)
    weights = replace(LossWeights(), match_alpha=0.0)
    plain = match_loss(pair, a._replace(C=unsure), b._replace(C=unsure), weights, generator())
    mixed = match_loss(pair, a._replace(C=sure), b._replace(C=unsure), weights, generator())
    assert float(mixed) == pytest.approx(2.0 * float(plain))
    rewarded = replace(weights, match_alpha=10.0)
    loss = match_loss(pair, a._replace(C=sure), b._replace(C=unsure), rewarded, generator())
    assert float(loss) == pytest.approx(float(mixed) - 10.0 * math.log(2.0))


def test_a_pixel_is_the_match_of_one_pixel() -> None:
    """The second view is thrice as far away: nine pixels of the first fall into one of it."""
    pair = shifted_pair(0.0)
    T_wc = pair.b.T_wc.clone()
    T_wc[:, 2, 3] = -4.0
    pair = Pair(pair.a, replace(pair.b, T_wc=T_wc, depth=3.0 * pair.b.depth))
    assert int(correspondences(pair).visible.sum()) > 36
    reciprocal, rows, columns = reciprocal_matches(pair)
    taken = torch.stack([rows[reciprocal], columns[reciprocal]], 1)
    assert len(taken) == len(taken.unique(dim=0)) == 36


def test_descriptors_of_the_scene_itself_beat_random_ones() -> None:
    pair = shifted_pair(0.5)
    a, b = said(pair)
    X_a, X_b = true_pointmaps(pair)

    def from_place(X: Tensor) -> Tensor:
        return F.normalize(torch.cat([(5 * X).sin(), (5 * X).cos()], -1), dim=-1)

    weights = LossWeights()
    random = match_loss(pair, a, b, weights, generator())
    placed = match_loss(
        pair, a._replace(D=from_place(X_a)), b._replace(D=from_place(X_b)), weights, generator()
    )
    assert float(placed) < float(random)


def test_a_pair_without_matches_costs_nothing_and_can_be_differentiated() -> None:
    pair = shifted_pair(99.0)
    a, b = said(pair)
    D = a.D.clone().requires_grad_()
    loss = match_loss(pair, a._replace(D=D), b, LossWeights(), generator())
    loss.backward()  # type: ignore[no-untyped-call]
    assert float(loss.detach()) == 0.0
    assert D.grad is not None
    assert float(D.grad.abs().max()) == 0.0


def test_total_is_points_plus_beta_times_match() -> None:
    pair = shifted_pair(0.5)
    weights = replace(LossWeights(), beta=0.5)
    losses = pair_loss(pair, *said(pair), weights, generator())
    assert torch.allclose(losses.total, losses.points + 0.5 * losses.match)


def test_metric_scale_is_part_of_the_loss() -> None:
    pair = shifted_pair(0.5)
    a, b = said(pair)
    X_a, X_b = true_pointmaps(pair)
    right = pair_loss(pair, a._replace(X=X_a), b._replace(X=X_b), LossWeights(), generator())
    scaled = a._replace(X=2 * X_a), b._replace(X=2 * X_b)
    wrong = pair_loss(pair, *scaled, LossWeights(), generator())
    assert float(right.points) < float(wrong.points)


def test_rate_rises_linearly_then_falls_along_half_a_cosine() -> None:
    schedule = Schedule(steps=101, warm_up=10, highest=1e-6, lowest=1e-7)
    assert schedule.rate(0) == pytest.approx(1e-7)
    assert schedule.rate(4) == pytest.approx(5e-7)
    assert schedule.rate(10) == pytest.approx(1e-6)
    assert schedule.rate(55) == pytest.approx(5.5e-7, rel=0.02)
    assert schedule.rate(100) == schedule.rate(1000) == pytest.approx(1e-7)
