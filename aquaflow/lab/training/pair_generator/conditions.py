"""How hard a use of a pair is: what is in the way, how the light is, and what the camera does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.lab.training.pair_generator.noise import Draw, periodic, spectral, wrap
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


# --------------------------------------------------------------------------------------------------
# What moves on its own between the two views: fish, and an arm of the vehicle or of its diver.
#
# Its pixels have no true match: they are marked as not valid in both views.

FISH = 3
"""In a pair, at most."""
FISH_LENGTH = (0.06, 0.25)
"""Half the length of a fish's body, as a share of the picture's width."""
FISH_SWIMS = 0.25
"""Deviation of the way between the two pictures, as a share of the picture's width."""
ARM_WIDTH = (0.05, 0.14)
"""Half the width of an arm, as a share of the picture's width."""
ARM_SWAYS = 0.06
"""Deviation of the way of its hand between the two pictures, as a share of the picture's width."""
NEARER = (0.25, 0.8)
"""Of the scene's median depth: where they are."""
SKIN_TEXELS = 32
"""Along a side of the pattern that a body wears in both pictures."""


def with_bodies(draw: Draw, pair: Pair) -> Pair:
    """The pair with up to FISH fish or an arm in front of it; before water."""
    batch = len(pair.a.K)
    depth = median_depth(pair.a) * draw.uniform(batch, low=NEARER[0], high=NEARER[1])
    skin = draw.uniform(batch, 3, SKIN_TEXELS, SKIN_TEXELS) * draw.uniform(batch, 1, 1, 1, high=0.5)
    skin = skin + draw.uniform(batch, 3, 1, 1, high=0.7)
    has_arm = draw.chance(0.4, batch, 1, 1)
    fish, arm = _fish(draw, pair.a), _arm(draw, pair.a)
    views = []
    for view, swims, sways in zip((pair.a, pair.b), fish, arm, strict=True):
        place = torch.where(has_arm[..., None], sways[0], swims[0])
        inside = torch.where(has_arm, sways[1], swims[1])
        views.append(_cover(view, place, inside, skin, depth))
    return Pair(*views)


def _cover(
    view: ViewBatch,
    place: Tensor,  # [B, H, W, 2] in the body's frame, in [-1, 1] on it
    inside: Tensor,  # [B, H, W] bool
    skin: Tensor,  # [B, 3, n, n]
    depth: Tensor,  # [B] m
) -> ViewBatch:
    pattern = F.grid_sample(skin, place, padding_mode="reflection", align_corners=False)
    # Backs are dark and bellies light on fish; a round arm is lit from above.
    shade = 0.75 - 0.35 * place[..., 1].clamp(-1.0, 1.0)
    image = torch.where(inside[:, None], pattern * shade[:, None], view.image)
    distance = torch.where(inside, depth[:, None, None], view.depth)
    return replace(view, image=image, depth=distance, valid=view.valid & ~inside)


Shapes = list[tuple[Tensor, Tensor]]
"""For both views: [B, H, W, 2] places in the body's frame, [B, H, W] bool: on it."""


def _fish(draw: Draw, view: ViewBatch) -> Shapes:
    batch, (height, width) = len(view.K), view.depth.shape[-2:]
    size = torch.tensor([width, height], device=draw.device)
    heading = draw.uniform(batch, FISH, high=2.0 * math.pi)
    centre = draw.uniform(batch, FISH, 2) * size
    long = draw.log_uniform(batch, FISH, low=FISH_LENGTH[0], high=FISH_LENGTH[1]) * width
    slim = draw.uniform(batch, FISH, low=0.25, high=0.5)
    there = draw.uniform(batch, FISH) < draw.uniform(batch, 1, low=0.34)
    there[:, 0] = True
    shapes = []
    for _ in "ab":
        place = torch.zeros(batch, height, width, 2, device=draw.device)
        inside = torch.zeros(batch, height, width, dtype=torch.bool, device=draw.device)
        for number in range(FISH):
            own = (
                _turn(view, centre[:, number], heading[:, number])
                / long[:, number, None, None, None]
            )
            x, y = own[..., 0], own[..., 1] / slim[:, number, None, None]
            tail = (x < -0.8) & (x > -1.5) & (own[..., 1].abs() < 0.5 * (-0.7 - x))
            on = ((x * x + y * y < 1.0) | tail) & there[:, number, None, None]
            place = torch.where(on[..., None], torch.stack([x, y], -1), place)
            inside = inside | on
        shapes.append((place, inside))
        centre = centre + draw.normal(batch, FISH, 2, sigma=FISH_SWIMS) * width
        heading = heading + draw.normal(batch, FISH, sigma=0.4)
    return shapes


def _arm(draw: Draw, view: ViewBatch) -> Shapes:
    """From the lower part of the picture's border inwards, nearly at rest in the picture."""
    batch, (height, width) = len(view.K), view.depth.shape[-2:]
    size = torch.tensor([width, height], device=draw.device)
    shoulder = torch.stack([draw.uniform(batch, low=-0.1, high=1.1), torch.full((batch,), 1.1)], -1)
    shoulder = shoulder.to(draw.device) * size
    hand = draw.uniform(batch, 2, low=0.25, high=0.75) * size
    half = draw.uniform(batch, low=ARM_WIDTH[0], high=ARM_WIDTH[1]) * width
    shapes = []
    for _ in "ab":
        along = hand - shoulder
        length = along.norm(dim=-1).clamp_min(1.0)
        own = _turn(view, shoulder, torch.atan2(along[:, 1], along[:, 0]))
        x = own[..., 0] / length[:, None, None]
        y = own[..., 1] / half[:, None, None]
        beyond = (own[..., 0] - length[:, None, None]).clamp_min(0.0) / half[:, None, None]
        inside = (x > 0.0) & (y.square() + beyond.square() < 1.0)
        shapes.append((torch.stack([2.0 * x - 1.0, y], -1), inside))
        hand = hand + draw.normal(batch, 2, sigma=ARM_SWAYS) * width
    return shapes


def _turn(
    view: ViewBatch,
    centre: Tensor,  # [B, 2] px
    angle: Tensor,  # [B] radians, of the x axis
) -> Tensor:
    """[B, H, W, 2] px of each pixel in a frame at ``centre``."""
    height, width = view.depth.shape[-2:]
    v, u = torch.meshgrid(
        torch.arange(height, device=centre.device) + 0.5,
        torch.arange(width, device=centre.device) + 0.5,
        indexing="ij",
    )
    x, y = (p[None] - c[:, None, None] for p, c in zip((u, v), centre.unbind(-1), strict=True))
    cos, sin = angle.cos()[:, None, None], angle.sin()[:, None, None]
    return torch.stack([cos * x + sin * y, cos * y - sin * x], -1)


# --------------------------------------------------------------------------------------------------
# Text and lines that the recorder burns in: they stay where they are while the scene moves.
#
# Their pixels show nothing of the scene and are marked as not valid in both views.

CHARACTERS = "0123456789:./-+ ABCDEFGHKMNPRSTXYdeghmnprst"
"""Of clocks, depths, headings and names."""
LINES = 4
"""Of text, at most."""
LONGEST = 14
"""Characters of a line of text."""
SCALE = (0.22, 0.5)
"""Of the font: capital letters of 5 to 11 px."""
CHANGING = 2
"""Last characters of a line that may differ between the two pictures: seconds, decimeters."""
SEE_THROUGH = (0.6, 1.0)
"""Opacity."""


def with_overlay(draw: Draw, pair: Pair) -> Pair:
    """The pair with one overlay per item; after the sensor."""
    drawn = [_draw(draw, *pair.a.depth.shape[-2:]) for _ in range(len(pair.a.K))]
    colour = draw.chance(0.7, len(drawn), 1, 1, 1).float()  # white, or black
    opacity = draw.uniform(len(drawn), 1, 1, 1, low=SEE_THROUGH[0], high=SEE_THROUGH[1])
    views = []
    for view, index in zip((pair.a, pair.b), (0, 1), strict=True):
        ink = torch.from_numpy(np.stack([both[index] for both in drawn])).to(draw.device)
        views.append(_ink(view, ink.float()[:, None] / 255.0, colour, opacity))
    return Pair(*views)


def _ink(
    view: ViewBatch,
    ink: Tensor,  # [B, 1, H, W] in [0, 1]
    colour: Tensor,  # [B, 1, 1, 1]
    opacity: Tensor,  # [B, 1, 1, 1]
) -> ViewBatch:
    image = torch.lerp(view.image, colour.expand_as(view.image), ink * opacity)
    covered = F.max_pool2d(ink, 3, 1, 1)[:, 0] > 0.0
    return replace(view, image=image, valid=view.valid & ~covered)


def _draw(
    draw: Draw, height: int, width: int
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """[H, W] ink in [0, 255] of both pictures."""
    first = np.zeros((height, width), np.uint8)
    second = first.copy()
    lines, *numbers = draw.whole(1 + LINES * (LONGEST + CHANGING), below=1 << 16).tolist()
    places = draw.uniform(LINES, 3).tolist()
    for number in range(1 + lines % LINES):
        own = numbers[number * (LONGEST + CHANGING) : (number + 1) * (LONGEST + CHANGING)]
        text = "".join(CHARACTERS[n % len(CHARACTERS)] for n in own[: 3 + own[0] % (LONGEST - 3)])
        later = text[:-CHANGING] + "".join(CHARACTERS[n % 10] for n in own[LONGEST:])
        x, y, large = places[number]
        scale = SCALE[0] + (SCALE[1] - SCALE[0]) * large
        # Mostly along the upper and lower border, as recorders write.
        row = (0.12 + 0.1 * y) if y < 0.45 else (0.8 + 0.18 * y) if y < 0.9 else 10.0 * (y - 0.9)
        at = (round((0.7 * x - 0.05) * width), round(min(row, 0.97) * height))
        for picture, words in ((first, text), (second, later)):
            cv2.putText(picture, words, at, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, 1, cv2.LINE_AA)
    kind = numbers[-1] % 6
    for picture in (first, second):
        _rule(picture, kind)
    return first, second


def _rule(
    picture: npt.NDArray[np.uint8],  # [H, W], drawn on
    kind: int,
) -> None:
    """0: cross-hairs; 1: a frame; 2: bars above and below; others: nothing."""
    height, width = picture.shape
    if kind == 0:
        middle, arm = (width // 2, height // 2), width // 12
        cv2.line(picture, (middle[0] - arm, middle[1]), (middle[0] + arm, middle[1]), 255, 1)
        cv2.line(picture, (middle[0], middle[1] - arm), (middle[0], middle[1] + arm), 255, 1)
    elif kind == 1:
        edge = width // 16
        cv2.rectangle(picture, (edge, edge), (width - edge, height - edge), 255, 1)
    elif kind == 2:
        picture[: height // 12] = 255
        picture[height - height // 12 :] = 255
