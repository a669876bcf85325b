"""How hard a use of a pair is: what is in the way, how the light is, and what the camera does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from aquaflow.lab.training.pair_generator.bodies import with_bodies
from aquaflow.lab.training.pair_generator.caustics import with_caustics
from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.low_light import in_low_light
from aquaflow.lab.training.pair_generator.motion_blur import with_motion_blur
from aquaflow.lab.training.pair_generator.overlays import with_overlay
from aquaflow.lab.training.pair_generator.particles import with_snow
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

    def scaled(self, factor: float) -> Conditions:
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
    chosen = _chosen(draw, share, len(images))
    if len(chosen) == 0:
        return images
    return images.index_put((chosen,), effect(draw, images[chosen]))


def _some_pairs(draw: Draw, share: float, pair: Pair, effect: Callable[[Draw, Pair], Pair]) -> Pair:
    """The pairs, ``effect`` on ``share`` of them."""
    chosen = _chosen(draw, share, len(pair.a.K))
    if len(chosen) == 0:
        return pair
    changed = effect(draw, Pair(_rows(pair.a, chosen), _rows(pair.b, chosen)))
    return Pair(_replaced(pair.a, chosen, changed.a), _replaced(pair.b, chosen, changed.b))


def _chosen(draw: Draw, share: float, batch: int) -> Tensor:
    """[N] int64; a share of zero draws nothing, so that calm pairs are what they always were."""
    if share == 0.0:
        return torch.zeros(0, dtype=torch.long, device=draw.device)
    return draw.chance(share, batch).nonzero()[:, 0]


def _rows(
    view: ViewBatch,
    chosen: Tensor,  # [N] int64
) -> ViewBatch:
    return ViewBatch(*(getattr(view, field.name)[chosen] for field in fields(view)))


def _replaced(
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
