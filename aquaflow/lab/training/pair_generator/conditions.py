"""How hard a use of a pair is: what is in the way, how the light is, and what the camera does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.bodies import with_bodies
from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.noise import periodic, spectral, wrap
from aquaflow.lab.training.pair_generator.overlays import with_overlay
from aquaflow.lab.training.pair_generator.render import median_depth
from aquaflow.lab.training.pairs import Pair, ViewBatch


@dataclass(frozen=True)
class Conditions:
    """Shares of the pairs, and for snow, blur and low light of the single pictures."""

    bodies: float = 0.1
    """Fish or an arm in front."""
    caustics: float = 0.1
    turbid: float = 0.1
    """Water that takes and adds more light than the table's."""
    snow: float = 0.1
    blur: float = 0.1
    low_light: float = 0.1
    overlay: float = 0.1

    def scale(self, factor: float) -> Conditions:
        """All shares times ``factor``: a training begins with what is easy."""
        return Conditions(*(factor * getattr(self, field.name) for field in fields(self)))

    def before_water(self, draw: Draw, pair: Pair) -> Pair:
        """Radiances with what stands in front, and under moving light."""
        pair = _some_pairs(draw, self.caustics, pair, with_caustics)
        return _some_pairs(draw, self.bodies, pair, with_bodies)

    def before_lens(
        self,
        draw: Draw,
        radiance: Tensor,  # [B, 3, H, W]
    ) -> Tensor:
        """[B, 3, H, W] what reaches the sensor during an exposure."""
        radiance = _some(draw, self.snow, radiance, with_snow)
        return _some(draw, self.blur, radiance, with_motion_blur)

    def after_sensor(self, draw: Draw, pair: Pair) -> Pair:
        """Pictures as they are recorded."""
        a, b = (
            replace(view, image=_some(draw, self.low_light, view.image, in_low_light))
            for view in (pair.a, pair.b)
        )
        return _some_pairs(draw, self.overlay, Pair(a, b), with_overlay)


CALM = Conditions(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""None of it."""


def _some(
    draw: Draw,
    share: float,
    images: Tensor,  # [B, 3, H, W]
    effect: Callable[[Draw, Tensor], Tensor],
) -> Tensor:
    """[B, 3, H, W], ``effect`` on ``share`` of them."""
    chosen = _choose(draw, share, len(images))
    if len(chosen) == 0:
        return images
    return images.index_put((chosen,), effect(draw, images[chosen]))


def _some_pairs(draw: Draw, share: float, pair: Pair, effect: Callable[[Draw, Pair], Pair]) -> Pair:
    """The pairs, ``effect`` on ``share`` of them."""
    chosen = _choose(draw, share, len(pair.a.K))
    if len(chosen) == 0:
        return pair
    changed = effect(draw, Pair(_rows(pair.a, chosen), _rows(pair.b, chosen)))
    return Pair(_replace(pair.a, chosen, changed.a), _replace(pair.b, chosen, changed.b))


def _choose(draw: Draw, share: float, batch: int) -> Tensor:
    """[N] int64; a share of zero draws nothing, so that calm pairs are what they always were."""
    if share == 0.0:
        return torch.zeros(0, dtype=torch.long, device=draw.device)
    return draw.chance(share, batch).nonzero()[:, 0]


def _rows(
    view: ViewBatch,
    chosen: Tensor,  # [N] int64
) -> ViewBatch:
    return ViewBatch(*(getattr(view, field.name)[chosen] for field in fields(view)))


def _replace(
    view: ViewBatch,
    chosen: Tensor,  # [N] int64
    new: ViewBatch,
) -> ViewBatch:
    return ViewBatch(
        *(
            getattr(view, field.name).index_put((chosen,), getattr(new, field.name))
            for field in fields(view)
        )
    )


# --------------------------------------------------------------------------------------------------
# Pictures taken with too little light: dim, noisy, and in few levels of grey.

LEVEL = (0.08, 0.5)
"""Of the brightness that automatic exposure aims at."""
NOISE = (0.003, 0.02)
"""Standard deviation of the noise, in full scale: against LEVEL a tenth of the signal."""
GREYS = 255.0
"""Levels of a camera's 8-bit output."""


def in_low_light(
    draw: Draw,
    image: Tensor,  # [B, 3, H, W] in [0, 1]
) -> Tensor:
    """[B, 3, H, W] in [0, 1]"""
    batch = len(image)
    dim = image * draw.log_uniform(batch, 1, 1, 1, low=LEVEL[0], high=LEVEL[1])
    noise = draw.log_uniform(batch, 1, 1, 1, low=NOISE[0], high=NOISE[1])
    dim = dim + draw.normal(*image.shape) * noise * (0.3 + dim.clamp_min(0.0)).sqrt()
    return (dim.clamp(0.0, 1.0) * GREYS).round() / GREYS


# --------------------------------------------------------------------------------------------------
# Dense marine snow: particles lit in front of the lens, small and sharp or near and blurred.

SHARE = (0.001, 0.012)
"""Of the pixels that show a particle."""
LIGHT = (0.2, 1.5)
"""Of a particle, relative to the picture's mean."""
LAYERS = (1, 3, 7)
"""px across a particle of each layer; the larger ones are nearer, fewer and out of focus."""


def with_snow(
    draw: Draw,
    radiance: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """[B, 3, H, W] with particles of the picture's own; another picture has others."""
    batch, _, height, width = radiance.shape
    share = draw.log_uniform(batch, 1, 1, 1, low=SHARE[0], high=SHARE[1])
    light = draw.uniform(batch, 1, 1, 1, low=LIGHT[0], high=LIGHT[1])
    snow = torch.zeros(batch, 1, height, width, device=draw.device)
    for across in LAYERS:
        there = draw.uniform(batch, 1, height, width) < share / across
        bright = there * draw.uniform(batch, 1, height, width)
        for _ in range(2 if across > 1 else 0):
            # Twice a box makes a round spot; its middle stays as bright as a small particle.
            bright = F.avg_pool2d(bright, across, 1, across // 2) * across**0.9
        snow = snow + bright
    mean = radiance.mean(dim=(1, 2, 3), keepdim=True)
    return radiance + mean * light * snow.clamp_max(2.0)


# --------------------------------------------------------------------------------------------------
# What a long exposure does: every point is drawn out along the camera's motion.

LENGTH_PX = (1.0, 6.0)
"""Way of a point during the exposure."""
TAPS = 9
"""Width of the kernel: holds the longest way in any direction."""
SAMPLES = 16
"""Instants of the exposure that are summed."""


def with_motion_blur(
    draw: Draw,
    radiance: Tensor,  # [B, 3, H, W]
) -> Tensor:
    """[B, 3, H, W], each picture along a direction of its own; points stay at the way's middle."""
    batch, channels = radiance.shape[:2]
    length = draw.uniform(batch, 1, low=LENGTH_PX[0], high=LENGTH_PX[1])
    angle = draw.uniform(batch, 1, high=2.0 * math.pi)
    instant = torch.linspace(-0.5, 0.5, SAMPLES, device=draw.device)[None]
    x, y = length * instant * angle.cos(), length * instant * angle.sin()
    axis = torch.arange(TAPS, device=draw.device) - TAPS // 2
    near_x = (1.0 - (axis[None, None] - x[..., None]).abs()).clamp_min(0.0)
    near_y = (1.0 - (axis[None, None] - y[..., None]).abs()).clamp_min(0.0)
    kernel = near_y.mT @ near_x / SAMPLES
    kernels = kernel[:, None].repeat_interleave(channels, 0)
    half = TAPS // 2
    padded = F.pad(radiance, (half, half, half, half), mode="reflect")
    flat = padded.view(1, batch * channels, *padded.shape[-2:])
    return F.conv2d(flat, kernels, groups=batch * channels).view_as(radiance)


# --------------------------------------------------------------------------------------------------
# Sunlight gathered by waves, drawn at each use of a pair: shallow water, where it moves fast.

TEXELS = 128
"""Along a side of the periodic pattern."""
PERIOD = (0.8, 4.0)
"""Of the pattern, in median depths of the scene."""
STRENGTH = (0.3, 1.0)
"""Share of the light that the waves move about."""
SLOPE = (1.6, 2.6)
"""Of the waves' power spectrum: from short to long-crested."""
BRIGHTEST = 3.5
"""Of the gathered light, relative to the mean."""


def with_caustics(draw: Draw, pair: Pair) -> Pair:
    """The pair's radiances under light that has moved on between the two pictures."""
    batch = len(pair.a.K)
    depth = median_depth(pair.a)[:, None, None]
    period = draw.log_uniform(batch, 1, 1, low=PERIOD[0], high=PERIOD[1]) * depth
    strength = draw.uniform(batch, 1, 1, low=STRENGTH[0], high=STRENGTH[1])
    waves = spectral(draw, TEXELS, draw.uniform(batch, low=SLOPE[0], high=SLOPE[1]))
    light = torch.exp(-draw.uniform(batch, 1, 1, low=2.0, high=6.0) * waves.abs())
    light = (light / light.mean(dim=(1, 2), keepdim=True)).clamp_max(BRIGHTEST)
    pattern = wrap(light[:, None])
    views = []
    for view in (pair.a, pair.b):
        moved = draw.uniform(batch, 1, 2)
        gathered = periodic(pattern, _places(view) / period + moved)
        shade = 1.0 + strength * (gathered - 1.0)
        views.append(replace(view, image=view.image * shade.view(batch, 1, *view.depth.shape[1:])))
    return Pair(*views)


def _places(view: ViewBatch) -> Tensor:
    """[B, H * W, 2] metres in the world's horizontal plane; waves are overhead."""
    points = view.points().flatten(1, 2) @ view.T_wc[:, :3, :3].mT + view.T_wc[:, None, :3, 3]
    return points[..., :2] + 0.3 * points[..., 2:]
