"""The compact prior's network: a siamese encoder, and a head that compares two encodings.

The encoder sees pictures whose local mean and contrast are made equal, and never where a pixel
lies: descriptors that know their position learn nothing else
(notes/2026-11-priors.md#compact-prior).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

STRIDE = 16
"""Sides of a picture are multiples of it, px."""
FINE, COARSE = 2, 8
"""Pixels between descriptors along a side."""
SHARPEST = 4.6
"""Largest logarithm of an inverse temperature."""
GROUP = 8
"""Channels that processors multiply at once."""
SMALLEST = 1e-30
"""Sum of exponentials below which a cell is like no other; far above what 32 bits can hold."""


@dataclass(frozen=True)
class NetworkSize:
    """Channels by level; defaults are those of the weights that ship.

    A checkpoint and an ONNX file hold it as the shapes of their weights (``size_of``).
    """

    levels: tuple[int, int, int, int] = (16, 32, 64, 128)
    """At 1/2, 1/4, 1/8 and 1/16."""
    merged: tuple[int, int, int] = (64, 40, 24)
    """On the way back, at 1/8, 1/4 and 1/2."""
    fine: int = 24
    """Numbers of a fine descriptor."""
    coarse: int = 64
    """Numbers of a coarse descriptor."""
    head: int = 32
    """Channels of the range head."""

    def times(self, factor: float) -> NetworkSize:
        """The size of about ``factor`` times as many weights; descriptors stay as long.

        Convolutions are wider, to whole groups of GROUP channels: their weights grow with the
        square.
        """

        def widen(channels: int) -> int:
            return channels if factor == 1.0 else GROUP * round(channels * factor**0.5 / GROUP)

        a, b, c, d = map(widen, self.levels)
        e, f, g = map(widen, self.merged)
        return NetworkSize((a, b, c, d), (e, f, g), self.fine, self.coarse, widen(self.head))


def size_of(
    weights: Mapping[str, Tensor],  # [...] each, by their names in CompactPrior
) -> NetworkSize:
    """The size that these weights are of.

    Raises:
        KeyError: they are of another network.
    """

    def channels(layer: str) -> int:
        return len(weights[f"{layer}.weight"])

    a, b, c, d = (channels(f"encoder.down_{n}.0.0") for n in (2, 4, 8, 16))
    e, f, g = (channels(f"encoder.up_{n}.below") for n in (8, 4, 2))
    fine, coarse = channels("encoder.fine"), channels("encoder.coarse")
    return NetworkSize((a, b, c, d), (e, f, g), fine, coarse, channels("comparison.range.0.0"))


class Encoded(NamedTuple):
    """The encoder's output for a picture."""

    D: Tensor
    """[B, fine, H/2, W/2] unit descriptors"""
    Dc: Tensor
    """[B, coarse, H/8, W/8] unit descriptors"""
    C: Tensor
    """[B, H/2, W/2] in (0, 1): how likely the pixel's match is found"""


class Compared(NamedTuple):
    """One way of a pair, by the coarse cells of the first picture."""

    pixels: Tensor
    """[B, 2, H/8, W/8] px in the other picture where the cell's centre is seen"""
    ray: Tensor
    """[B, 2, H/8, W/8] the same in ray units: x / z, y / z in the other camera"""
    score: Tensor
    """[B, H/8, W/8] in [0, 1]: probability of that place and its neighbours"""
    log_range: Tensor
    """[B, H/8, W/8] logarithm of the distance, up to the pair's scale"""
    log_variance: Tensor
    """[B, H/8, W/8] of log_range"""


class CompactPrior(nn.Module):
    """Both parts and the temperatures that matching is trained with."""

    def __init__(self, size: NetworkSize | None = None) -> None:
        super().__init__()
        size = size or NetworkSize()
        self.size = size
        self.encoder = Encoder(size)
        self.comparison = CompactDecoder(size)
        self.fine_sharpness = nn.Parameter(torch.tensor(2.6))

    def encode(
        self,
        image: Tensor,  # [B, 3, H, W] RGB in [0, 1], sides multiples of 16
    ) -> Encoded:
        """Nothing of it depends on another picture."""
        encoded: Encoded = self.encoder(image)
        return encoded


class Encoder(nn.Module):
    """Residual levels down to 1/16, and back up by sums to 1/2."""

    def __init__(self, size: NetworkSize) -> None:
        super().__init__()
        a, b, c, d = size.levels
        e, f, g = size.merged
        self.down_2 = nn.Sequential(convolve(3, a, 5, 2), Residual(a))
        self.down_4 = nn.Sequential(convolve(a, b, 3, 2), Residual(b))
        self.down_8 = nn.Sequential(convolve(b, c, 3, 2), Residual(c), Residual(c))
        self.down_16 = nn.Sequential(convolve(c, d, 3, 2), Residual(d), Residual(d), Residual(d))
        self.up_8, self.up_4, self.up_2 = Up(d, c, e), Up(e, b, f), Up(f, a, g)
        self.coarse = nn.Conv2d(e, size.coarse, 1)
        self.fine = nn.Conv2d(g, size.fine, 1)
        self.trust = nn.Conv2d(g, 1, 3, padding=1)

    def forward(
        self,
        image: Tensor,  # [B, 3, H, W]
    ) -> Encoded:
        at_2 = self.down_2(locally_normalised(image))
        at_4 = self.down_4(at_2)
        at_8 = self.down_8(at_4)
        merged_8 = self.up_8(self.down_16(at_8), at_8)
        merged_2 = self.up_2(self.up_4(merged_8, at_4), at_2)
        D = F.normalize(self.fine(merged_2).float(), dim=1)
        Dc = F.normalize(self.coarse(merged_8).float(), dim=1)
        return Encoded(D, Dc, torch.sigmoid(self.trust(merged_2.detach()).float())[:, 0])


class CompactDecoder(nn.Module):
    """Coarse matches of a pair, and from them and the rays a rough range."""

    def __init__(self, size: NetworkSize) -> None:
        super().__init__()
        self.sharpness = nn.Parameter(torch.tensor(2.6))
        self.range = nn.Sequential(
            convolve(size.coarse + 5, size.head, 3, 1),
            Residual(size.head, dilation=2),
            Residual(size.head, dilation=4),
            nn.Conv2d(size.head, 2, 1),
        )

    def scores(
        self,
        Dc_a: Tensor,  # [B, d, h, w]
        Dc_b: Tensor,  # [B, d, h, w]
    ) -> Tensor:
        """[B, cells of a, cells of b] products of descriptors over the temperature."""
        products = Dc_a.flatten(2).mT @ Dc_b.flatten(2)
        return products * self.sharpness.clamp_max(SHARPEST).exp()

    def forward(
        self,
        Dc_a: Tensor,  # [B, d, h, w]
        Dc_b: Tensor,  # [B, d, h, w]
        rays_a: Tensor,  # [B, 2, h, w] x / z, y / z of the cells' centres
        rays_b: Tensor,  # [B, 2, h, w]
    ) -> tuple[Compared, Compared]:
        """Outputs from a to b, and from b to a."""
        # Products of unit descriptors are at most 1, so no exponential is above 1.
        sharpness = self.sharpness.clamp_max(SHARPEST).exp()
        alike = torch.exp(self.scores(Dc_a, Dc_b) - sharpness)
        of_a = alike.sum(2, keepdim=True).clamp_min(SMALLEST)
        of_b = alike.sum(1, keepdim=True).clamp_min(SMALLEST)
        # The mutual probability is alike^2 / (of_a of_b); its largest place needs one of the two.
        best_b = (alike * of_b.rsqrt()).argmax(2)
        best_a = (alike * of_a.rsqrt()).argmax(1)
        return (
            self._one_way(Dc_a, rays_a, rays_b, alike, of_a[..., 0], best_b),
            self._one_way(Dc_b, rays_b, rays_a, alike.mT, of_b[:, 0], best_a),
        )

    def _one_way(
        self,
        Dc: Tensor,  # [B, d, h, w]
        rays: Tensor,  # [B, 2, h, w]
        rays_other: Tensor,  # [B, 2, h', w']
        alike: Tensor,  # [B, cells, cells of the other]
        total: Tensor,  # [B, cells] its sums
        best: Tensor,  # [B, cells] the best cell of the other
    ) -> Compared:
        cells, place, inside = _around(best, rays_other.shape[-2], rays_other.shape[-1])
        weight = torch.where(inside, alike.gather(2, cells), 0.0) / total[..., None]
        score = weight.sum(2)
        weight = weight / score[..., None].clamp_min(1e-6)
        flat = cells.flatten(1)[:, None].expand(-1, 2, -1)
        there = rays_other.flatten(2).gather(2, flat).view_as(place)
        shape = (len(Dc), 2, *rays.shape[-2:])
        pixels = (COARSE * (weight[:, None] * place).sum(3)).view(shape)
        ray = (weight[:, None] * there).sum(3).view(shape)
        score = score.view(len(Dc), *rays.shape[-2:])
        known = torch.cat([Dc, ray - rays, rays, score[:, None]], 1).detach()
        log_range, log_variance = self.range(known).float().unbind(1)
        return Compared(pixels, ray, score, log_range, log_variance)


def cell_rays(
    K: Tensor,  # [B, 3, 3] px
    height: int,
    width: int,
) -> Tensor:
    """[B, 2, H/8, W/8] x / z and y / z of the centres of the coarse cells of a pinhole camera."""
    rows, columns = height // COARSE, width // COARSE
    u = (torch.arange(columns, device=K.device) + 0.5) * COARSE
    v = (torch.arange(rows, device=K.device) + 0.5) * COARSE
    x = (u - K[:, 0, 2, None]) / K[:, 0, 0, None]
    y = (v - K[:, 1, 2, None]) / K[:, 1, 1, None]
    return torch.stack([x[:, None].expand(-1, rows, -1), y[:, :, None].expand(-1, -1, columns)], 1)


def _around(
    best: Tensor,  # [B, N] int64
    height: int,
    width: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """The 3 x 3 cells around each, held in the picture: [B, N, 9] their numbers, [B, 2, N, 9] the
    column and row of their middles, and [B, N, 9] bool: inside."""
    row = best // width
    column = best - row * width  # a remainder by a size that is not fixed cannot be exported
    step = torch.arange(9, device=best.device)
    x, y = column[..., None] + step % 3 - 1, row[..., None] + step // 3 - 1
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
    return y * width + x, torch.stack([x, y], 1) + 0.5, inside


# --------------------------------------------------------------------------------------------------
# What the compact prior's network is made of.

CONTRAST_WINDOW = 8
"""px of the blocks whose mean and contrast are smoothed and taken away."""
CONTRAST_FLOOR = 1e-4
"""Variance, picture in [0, 1], below which contrast is noise."""


def locally_normalised(
    image: Tensor,  # [B, 3, H, W] in [0, 1]
) -> Tensor:
    """[B, 3, H, W] of mean about 0 and contrast about 1 around every pixel."""
    centred = image - _smooth(image)
    return centred * torch.rsqrt(_smooth(centred * centred) + CONTRAST_FLOOR)


def _smooth(
    image: Tensor,  # [B, C, H, W]
) -> Tensor:
    blocks = F.avg_pool2d(image, CONTRAST_WINDOW)
    blocks = F.avg_pool2d(blocks, 3, 1, 1, count_include_pad=False)
    return F.interpolate(
        blocks, scale_factor=float(CONTRAST_WINDOW), mode="bilinear", align_corners=False
    )


def convolve(channels: int, out: int, size: int, stride: int, dilation: int = 1) -> nn.Sequential:
    """Convolution, normalisation over the batch, ReLU."""
    padding = size // 2 * dilation
    return nn.Sequential(
        nn.Conv2d(channels, out, size, stride, padding, dilation, bias=False),
        nn.BatchNorm2d(out),
        nn.ReLU(inplace=True),
    )


def normalised(
    network: nn.Module,
) -> Iterator[tuple[nn.Sequential, int, nn.Conv2d, nn.BatchNorm2d]]:
    """Every convolution with the normalisation after it, and where it is."""
    for module in network.modules():
        if isinstance(module, nn.Sequential):
            for index, (conv, norm) in enumerate(pairwise(list(module))):
                if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                    yield module, index, conv, norm


class Residual(nn.Module):
    """Residual block of two convolutions."""

    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.first = convolve(channels, channels, 3, 1, dilation)
        self.second = convolve(channels, channels, 3, 1)[:2]

    def forward(
        self,
        x: Tensor,  # [B, C, H, W]
    ) -> Tensor:
        return F.relu(x + self.second(self.first(x)))


class Up(nn.Module):
    """Twice the resolution, summed with what the way down had there."""

    def __init__(self, below: int, beside: int, out: int) -> None:
        super().__init__()
        self.below, self.beside = nn.Conv2d(below, out, 1), nn.Conv2d(beside, out, 1)
        self.refined = Residual(out)

    def forward(
        self,
        below: Tensor,  # [B, C, H/2, W/2]
        beside: Tensor,  # [B, C', H, W]
    ) -> Tensor:
        raised = F.interpolate(
            self.below(below), scale_factor=2.0, mode="bilinear", align_corners=False
        )
        refined: Tensor = self.refined(F.relu(raised + self.beside(beside)))
        return refined


# --------------------------------------------------------------------------------------------------
# From encodings to matches of single pixels: coarse cell, then the fine descriptors around it.

WINDOW = 6
"""Fine cells searched on either side of where the coarse match points."""


def coarse_at(
    pixels: Tensor,  # [B, 2, h, w] px, coarse matches of the cells' centres
    places: Tensor,  # [B, N, 2] px in the first picture
) -> Tensor:
    """[B, N, 2] px: each pixel moves as the centre of its cell does."""
    height, width = pixels.shape[-2:]
    column = (places[..., 0] / COARSE).long().clamp(0, width - 1)
    row = (places[..., 1] / COARSE).long().clamp(0, height - 1)
    index = (row * width + column)[:, None].expand(-1, 2, -1)
    there = pixels.flatten(2).gather(2, index).mT
    centre = torch.stack([column + 0.5, row + 0.5], -1) * COARSE
    return there + places - centre


def fine_around(
    D_a: Tensor,  # [B, d, H/2, W/2]
    D_b: Tensor,  # [B, d, H/2, W/2]
    places: Tensor,  # [B, N, 2] px in the first picture
    expected: Tensor,  # [B, N, 2] px in the second
) -> tuple[Tensor, Tensor]:
    """[B, N, 2] px, the most alike descriptor near ``expected``, to sub-pixel; [B, N] its product.

    Sub-pixel places come from a parabola through the best product and its neighbours, per axis.
    """
    own = descriptors_at(D_a, places)
    cells, products = window_products(own, D_b, expected, WINDOW)
    side = 2 * WINDOW + 1
    best = products.argmax(2)
    middle = products.gather(2, best[..., None])[..., 0]
    offset = torch.stack(
        [
            _parabola(products, best, middle, best % side, 1, side),
            _parabola(products, best, middle, best // side, side, side),
        ],
        -1,
    )
    found = cells.gather(2, best[..., None, None].expand(-1, -1, 1, 2))[:, :, 0]
    return (found + 0.5 + offset) * FINE, middle


def window_products(
    own: Tensor,  # [B, N, d] unit
    D: Tensor,  # [B, d, h, w] unit
    expected: Tensor,  # [B, N, 2] px
    reach: int,
) -> tuple[Tensor, Tensor]:
    """[B, N, K, 2] fine cells (column, row) around ``expected`` and [B, N, K] products there.

    Cells beyond the picture have the product -1.
    """
    height, width = D.shape[-2:]
    axis = torch.arange(-reach, reach + 1, device=D.device)
    shift = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1).flatten(0, 1)
    cells = (expected / FINE).floor().long()[:, :, None] + shift
    limit = torch.tensor([width, height], device=D.device)
    inside = ((cells >= 0) & (cells < limit)).all(-1)
    held = torch.minimum(cells.clamp_min(0), limit - 1)
    index = (held[..., 1] * width + held[..., 0]).flatten(1)
    batch = torch.arange(len(D), device=D.device)[:, None]
    there = D.flatten(2).mT[batch, index].reshape(*cells.shape[:3], -1)
    products = (there @ own[..., None])[..., 0]
    return cells, torch.where(inside, products, -1.0)


def descriptors_at(
    D: Tensor,  # [B, d, h, w]
    places: Tensor,  # [B, N, 2] px
) -> Tensor:
    """[B, N, d] bilinear, of unit length again."""
    size = torch.tensor(D.shape[:-3:-1], device=D.device) * FINE
    grid = (places / size * 2.0 - 1.0)[:, :, None]
    values = F.grid_sample(D, grid, padding_mode="border", align_corners=False)[..., 0]
    return F.normalize(values, dim=1).mT


def _parabola(
    products: Tensor,  # [B, N, K]
    best: Tensor,  # [B, N]
    middle: Tensor,  # [B, N]
    place: Tensor,  # [B, N] of the best along the axis
    step: int,
    side: int,
) -> Tensor:
    """[B, N] in cells, zero at the window's rim."""
    last = products.shape[2] - 1
    before = products.gather(2, (best - step).clamp_min(0)[..., None])[..., 0]
    after = products.gather(2, (best + step).clamp_max(last)[..., None])[..., 0]
    offset = 0.5 * (before - after) / (before - 2.0 * middle + after).clamp_max(-1e-6)
    return torch.where((place > 0) & (place < side - 1), offset.clamp(-0.5, 0.5), 0.0)
