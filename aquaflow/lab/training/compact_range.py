"""How well the compact prior knows distances, and whether it knows how well it does."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from aquaflow.lab.networks.compact.network import COARSE, Compared, Encoded, cell_rays
from aquaflow.lab.training.pairs import Pair, ViewBatch

LN_2 = 0.6931
LOG_SPREADS = (-4.0, 2.0)
"""Of Laplace's b that the loss distinguishes: no picture shows ranges to better than 2 %."""

Compare = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Compared, Compared]]
"""Coarse descriptors of a and b and rays of a and b: what Comparison takes and gives."""


def range_error(view: ViewBatch, said: Compared) -> tuple[Tensor, Tensor]:
    """[B, cells] error of log_range, the pair's scale included, and [B, cells] bool: known."""
    height, width = view.depth.shape[-2:]
    middle = slice(COARSE // 2, None, COARSE)
    distance = view.depth * view.rays(height, width).norm(dim=-1)
    truth = distance[:, middle, middle].clamp_min(1e-2).log()
    return (said.log_range - truth).flatten(1), view.valid[:, middle, middle].flatten(1)


def range_loss(
    pair: Pair,
    one: Compared,
    other: Compared,
    ranged: Tensor | None = None,  # [B] bool, None: all
) -> Tensor:
    """|error| / b + log b of log-ranges, after the pair's scale was taken from both views.

    It is the negative logarithm of Laplace's likelihood, whose b is honest where it is least.
    """
    errors, known, log_b = [], [], []
    for view, said in ((pair.a, one), (pair.b, other)):
        error, valid = range_error(view, said)
        errors.append(error)
        known.append(valid)
        log_b.append(0.5 * (said.log_variance.flatten(1) - LN_2))  # variance = 2 b^2
    error, valid, spread = torch.cat(errors, 1), torch.cat(known, 1), torch.cat(log_b, 1)
    if ranged is not None:
        valid = valid & ranged[:, None]
    scale = torch.where(valid, error.detach(), torch.nan).nanmedian(1, keepdim=True).values
    spread = spread.clamp(*LOG_SPREADS)
    loss = (error - scale.nan_to_num()).abs() * torch.exp(-spread) + spread
    return torch.where(valid, loss, 0.0).sum() / valid.sum().clamp_min(1)


@torch.no_grad()
def normalised_errors(
    encode: Callable[[Tensor], Encoded], compare: Compare, pairs: Sequence[Pair]
) -> Tensor:
    """[N] errors of log-range over their predicted deviations, of all known cells of both views.

    A picture's median error is taken away: ranges are known up to a factor.
    """
    found = []
    for pair in pairs:
        a, b = encode(pair.a.image), encode(pair.b.image)
        height, width = pair.a.depth.shape[-2:]
        rays = [cell_rays(view.K, height, width) for view in (pair.a, pair.b)]
        for view, said in zip((pair.a, pair.b), compare(a.Dc, b.Dc, *rays), strict=True):
            error, known = range_error(view, said)
            error = torch.where(known, error, torch.nan)
            error = error - error.nanmedian(1, keepdim=True).values
            over = error * torch.exp(-0.5 * said.log_variance.flatten(1))
            found.append(over[known])
    return torch.cat(found)


def variance_factor(
    errors: Tensor,  # [N] normalised
) -> float:
    """By which variances have to be multiplied to be those of ``errors``.

    Errors have heavier tails than a normal distribution, but fusion by inverse variance needs their
    mean square, whatever their distribution.
    """
    return float(errors.square().mean())


def calibration_figures(
    errors: Tensor,  # [N] normalised
) -> dict[str, float]:
    """Root mean square, 1 if variances are honest, and the shares within one and two deviations."""
    size = errors.abs()
    return {
        "range_normalised_rms": float(size.square().mean().sqrt()),
        "range_within_1": float((size < 1.0).float().mean()),
        "range_within_2": float((size < 2.0).float().mean()),
    }
