"""How many true matches of held-out generated pairs the compact prior's descriptors find."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from aquaflow.lab.networks.compact.export import INPUTS
from aquaflow.lab.networks.compact.network import (
    FINE,
    Compared,
    Encoded,
    cell_rays,
    coarse_at,
    descriptors_at,
    fine_around,
)
from aquaflow.lab.training.compact_range import Compare, range_error
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pairs import Correspondences, Pair, correspondences
from aquaflow.prior import flow as dense
from aquaflow.prior.flow import sample
from aquaflow.prior.hybrid import coarse_flow
from aquaflow.prior.runtime import NetworkSession, RuntimeSettings

SEED = 1000
"""Of the matches looked up."""
PLACES = 400
"""Matches looked up in each pair."""


def mean_recall(
    encode: Callable[[Tensor], Encoded], compare: Compare, pairs: Sequence[Pair]
) -> dict[str, float]:
    """The figures of ``recall_of``, means over batches."""
    rows = [recall_of(encode, compare, pair) for pair in pairs]
    return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}


@torch.no_grad()
def recall_of(
    encode: Callable[[Tensor], Encoded], compare: Compare, pair: Pair
) -> dict[str, float]:
    """Shares of true matches that are found: by the whole picture's nearest fine descriptor, by
    the coarse cell (8 px), and from coarse to fine within 1, 2 and 4 px; and the log-range error.
    """
    a, b = encode(pair.a.image), encode(pair.b.image)
    height, width = pair.a.depth.shape[-2:]
    rays = [cell_rays(view.K, height, width) for view in (pair.a, pair.b)]
    one, _ = compare(a.Dc, b.Dc, *rays)
    draw = Draw(SEED, pair.a.image.device)
    here, there, use = drawn_matches(correspondences(pair), PLACES, draw)
    expected = coarse_at(one.pixels, here)
    fine, _ = fine_around(a.D, b.D, here, expected)
    anywhere = (descriptors_at(a.D, here) @ b.D.flatten(2)).argmax(2)
    columns = b.D.shape[-1]
    nearest = (torch.stack([anywhere % columns, anywhere // columns], -1) + 0.5) * FINE

    def share(pixels: Tensor, within: float) -> float:
        return float(((pixels - there).norm(dim=-1) < within)[use].float().mean())

    figures = {"anywhere_2px": share(nearest, 2.0), "coarse_8px": share(expected, 8.0)}
    figures |= {f"fine_{px}px": share(fine, float(px)) for px in (1, 2, 4)}
    figures["log_range"] = _range_error(pair, one)
    return figures


@torch.no_grad()
def tracked_recall(
    encode: Callable[[Tensor], Encoded] | None, pairs: list[Pair]
) -> dict[str, float]:
    """Shares of true matches that are found as in tracking, where mutual coarse matches are made
    smooth first (prior.coarse): by them alone (8 px), by the fine descriptors around (2 px), and by
    dense flow that starts from them (2 px). Without an encoder flow starts from nothing.
    """
    matcher = dense.FlowMatcher()
    found: dict[str, list[Tensor]] = {"smooth_8px": [], "smooth_fine_2px": [], "flow_2px": []}
    for pair in pairs:
        here, there, use = drawn_matches(correspondences(pair), PLACES, Draw(SEED))
        images = (pair.a.image, pair.b.image)
        encoded = None if encode is None else [encode(image) for image in images]
        starts = _coarse_starts(encoded, pair)
        expected = _move_pixels(here, starts)
        greys = [[_grey(picture) for picture in image] for image in images]
        flows = [_flow(matcher, *g) for g in zip(*greys, starts, strict=True)]
        places = {"smooth_8px": expected, "flow_2px": _move_pixels(here, flows)}
        if encoded is not None:
            places["smooth_fine_2px"], _ = fine_around(encoded[0].D, encoded[1].D, here, expected)
        for name, pixels in places.items():
            within = 8.0 if name == "smooth_8px" else 2.0
            found[name].append(((pixels - there).norm(dim=-1) < within)[use])
    return {name: float(torch.cat(hits).float().mean()) for name, hits in found.items() if hits}


def onnx_encoder(path: Path) -> Callable[[Tensor], Encoded]:
    """An exported encoder in the place of the network's."""
    session = NetworkSession(path, RuntimeSettings(device="cpu"))

    def encode(images: Tensor) -> Encoded:
        rows = [session({"image": image[None].numpy()}) for image in images]
        return Encoded(
            *(torch.from_numpy(np.concatenate([row[x] for row in rows])) for x in Encoded._fields)
        )

    return encode


def onnx_comparison(path: Path) -> Compare:
    """An exported decoder in the place of the network's comparison."""
    session = NetworkSession(path, RuntimeSettings(device="cpu"))

    def compare(*inputs: Tensor) -> tuple[Compared, Compared]:
        rows = []
        for item in range(len(inputs[0])):
            given = {
                name: x[item : item + 1].numpy() for name, x in zip(INPUTS, inputs, strict=True)
            }
            rows.append(session(given))
        one, other = (
            Compared(
                *(
                    torch.from_numpy(np.concatenate([row[f"{name}_{way}"] for row in rows]))
                    for name in Compared._fields
                )
            )
            for way in ("ab", "ba")
        )
        return one, other

    return compare


def drawn_matches(found: Correspondences, count: int, draw: Draw) -> tuple[Tensor, Tensor, Tensor]:
    """[B, N, 2] px in a, [B, N, 2] px in b, [B, N] bool: false for pairs with too few matches."""
    batch, _, width = found.visible.shape
    weights = found.visible.flatten(1).float()
    enough = weights.sum(1) > count
    index = torch.multinomial(weights + 1e-9, count, generator=draw.generator)
    here = torch.stack([index % width + 0.5, index // width + 0.5], -1)
    there = found.pixels.flatten(1, 2).gather(1, index[..., None].expand(-1, -1, 2))
    return here, there, enough[:, None].expand(batch, count)


def _range_error(pair: Pair, said: Compared) -> float:
    """Mean over pairs of the median |error| after the median was taken away."""
    error, known = range_error(pair.a, said)
    error = torch.where(known, error, torch.nan)
    error = error - error.nanmedian(1, keepdim=True).values
    return float(error.abs().nanmedian(1).values.nanmean())


def _coarse_starts(encoded: list[Encoded] | None, pair: Pair) -> list[dense.Float | None]:
    """[H, W, 2] px for each item of the batch."""
    if encoded is None:
        return [None] * len(pair.a.image)
    size = (pair.a.depth.shape[-2], pair.a.depth.shape[-1])
    a, b = (x.Dc.permute(0, 2, 3, 1).numpy() for x in encoded)
    return [coarse_flow(one, other, *size) for one, other in zip(a, b, strict=True)]


def _flow(
    matcher: dense.FlowMatcher, a: dense.Grey, b: dense.Grey, start: dense.Float | None
) -> dense.Float:
    """[H, W, 2] px"""
    return matcher(a, b, dense.texture(a), dense.texture(b), start).forward


def _move_pixels(
    here: Tensor,  # [B, N, 2] px
    flows: Sequence[dense.Float | None],  # [H, W, 2] px; None moves nothing
) -> Tensor:
    """[B, N, 2] px"""
    rows = []
    for places, flow in zip(here, flows, strict=True):
        step = 0.0 if flow is None else torch.from_numpy(sample(flow, places[None].numpy())[0])
        rows.append(places + step)
    return torch.stack(rows)


def _grey(
    image: Tensor,  # [3, H, W] in [0, 1]
) -> dense.Grey:
    """[H, W] with local contrast equalised."""
    picture = (255.0 * image).round().byte().permute(1, 2, 0)
    return dense.normalised_grey(np.ascontiguousarray(picture.numpy()))
