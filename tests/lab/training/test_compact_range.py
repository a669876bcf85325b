"""The learned range's uncertainty: learnt as a likelihood, measured, made honest by a factor."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from aquaflow.lab.networks.compact.network import COARSE, Compared, Encoded
from aquaflow.lab.training.compact import covered_trust
from aquaflow.lab.training.compact_range import (
    calibration_figures,
    normalised_errors,
    range_loss,
    variance_factor,
)
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pairs import Pair, ViewBatch

pytestmark = pytest.mark.usefixtures("one_thread")

SIDE = 128
B = 0.2


def view() -> ViewBatch:
    """A plane 2 m away."""
    depth = torch.full((1, SIDE, SIDE), 2.0)
    K = torch.tensor([[[100.0, 0.0, SIDE / 2], [0.0, 100.0, SIDE / 2], [0.0, 0.0, 1.0]]])
    return ViewBatch(torch.zeros(1, 3, SIDE, SIDE), depth, K, torch.eye(4)[None], depth > 0)


def said(seed: int, log_variance: float | Tensor) -> Compared:
    """Log-ranges with Laplace's errors of spread B, and a scale of their own."""
    cells = SIDE // COARSE
    rng = np.random.default_rng(seed)
    error = torch.from_numpy(rng.laplace(0.0, B, (1, cells, cells))).float()
    distance = view().depth * view().rays(SIDE, SIDE).norm(dim=-1)
    truth = distance[:, COARSE // 2 :: COARSE, COARSE // 2 :: COARSE].log()
    spread = torch.as_tensor(log_variance).expand_as(truth)
    nothing = torch.zeros(1, 2, cells, cells)
    return Compared(nothing, nothing, nothing[:, 0], truth + error + 0.7, spread)


def test_the_loss_is_least_where_the_variance_is_that_of_the_errors() -> None:
    log_variance = torch.tensor(0.0, requires_grad=True)
    optimiser = torch.optim.Adam([log_variance], lr=0.05)
    for _ in range(200):
        optimiser.zero_grad()
        range_loss(Pair(view(), view()), said(1, log_variance), said(2, log_variance)).backward()
        optimiser.step()
    assert float(log_variance.detach().exp()) == pytest.approx(2.0 * B * B, rel=0.15)


def test_pairs_without_range_teach_none() -> None:
    pair = Pair(view(), view())
    none = torch.zeros(1, dtype=torch.bool)
    assert float(range_loss(pair, said(1, 0.0), said(2, 0.0), none)) == 0.0


def test_the_factor_makes_the_normalised_error_one() -> None:
    pair = Pair(view(), view())

    def encode(image: Tensor) -> Encoded:
        return Encoded(image, image, image)

    def compare(*_: Tensor) -> tuple[Compared, Compared]:
        return said(1, math.log(0.02)), said(2, math.log(0.02))

    errors = normalised_errors(encode, compare, [pair])
    assert len(errors) == 2 * (SIDE // COARSE) ** 2
    factor = variance_factor(errors)
    assert factor == pytest.approx(2.0 * B * B / 0.02, rel=0.2)
    figures = calibration_figures(errors / factor**0.5)
    assert figures["range_normalised_rms"] == pytest.approx(1.0)
    assert 0.6 < figures["range_within_1"] < figures["range_within_2"] < 1.0


def test_trust_in_what_covers_the_scene_is_costly() -> None:
    depth = torch.ones(1, 8, 8)
    depth[:, :, 4:] = 0.0
    trusting = torch.full((1, 4, 4), 0.99)
    wary = trusting.clone()
    wary[:, :, 2:] = 0.01
    assert float(covered_trust(trusting, depth, 6, Draw(1))) > 2.0
    assert float(covered_trust(wary, depth, 6, Draw(1))) < 0.05
    assert float(covered_trust(trusting, depth[:, :, :4], 6, Draw(1))) == 0.0
