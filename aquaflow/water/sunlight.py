"""How sunlight plays over the scene: waves above focus it into patterns that come and go.

In clear shallow water they change the brightness of the ground by ten percent and more, place by
place and view by view, which one map cannot show. So each view has a coarse field of gains that
multiplies its picture, and the map keeps the mean of the light. Like an exposure (exposure.py) the
field needs no gradient: in every cell it is the ratio of the picture to the drawing. A view that
was never mapped lies between its neighbours in time.

The map's own errors look like light too, but differ from view to view as much as they vary at all:
where neighbours do not predict a view's field, nothing is changed, and its cells are as fine as
neighbours predict what finer ones add. The paper has no such light. Measured: the missed share
below is 0.1 on the reef clip, 0.3 on Curasao, 1.0 on dives without.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from aquaflow.config import SunlightConfig
from aquaflow.render.views import View

COLUMNS = (8, 12, 24)
"""Cells of a field across the picture, from coarse to fine. On the reef clip 24 give 1.6 dB more
than 8, and on a rendered dive in moving light the scene in even light is 0.3 dB nearer to the
truth."""
EVERY_PX = 2
"""Of the rows and columns, the share that is looked at: enough for the mean of a cell."""
SOLID = 0.9
"""Alpha above which the drawing says something about the picture."""
LEAST_SHARE = 0.25
"""Share of a cell's pixels that must be usable, else it stays as it was."""
DARK = 0.02
"""Added to both sides of the ratio: what little the dark says is mostly noise."""
TOWARDS_ONE = 0.05
"""Share of a log-gain that is taken back each time: the pull that keeps their mean in the map."""
MAX_LOG_GAIN = 0.7
"""Twice as bright, or half: over an area as large as a cell, waves do not focus more."""
LEAST_LIGHT = 0.01
"""Root mean square of the log-gains below which they are not worth their time."""
MOST_MISSED, FINER_MISSED = 0.5, 0.75
"""Share of the fields' energy that their neighbours in time may fail to predict, and of what finer
cells add to it. What 12 cells add to 8 and 24 to 12: reef clip 0.11 and 0.24, rendered 0.27 and
0.42, Curasao 0.70, where it still gives 0.1 dB, and 0.88."""
FEWEST_VIEWS = 20
"""With fewer, the errors of a young map, which change slowly, look like light: a missed share of
0.2 after 12 views of a dive without sun, 1.1 after 22."""


class Sunlight:
    """The light on the views of one map."""

    def __init__(self, config: SunlightConfig) -> None:
        self.config = config
        self.columns = 0
        """Cells across the picture of the light that the views' fields proved to be; 0 until then.
        From then on pictures are drawn in it."""

    def judge(
        self,
        views: Sequence[View],  # in the order of their frames
    ) -> None:
        """Look how fine the light is that plays over ``views``; once it does, it always may."""
        if self.config.enabled:
            self.columns = max(self.columns, columns_of_light(views))

    def learn(
        self,
        view: View,
        image: Tensor,  # [H, W, 3] the map from this view, in even light
        alpha: Tensor,  # [H, W]
        exposure: Tensor | None,  # [3] gain of the view; None: one
    ) -> None:
        """Set the light of ``view`` from its picture."""
        if self.config.enabled:
            learn_light(view, image, alpha, exposure)

    def over(
        self,
        view: View,
        exposure: Tensor | None,  # [3] gain of the view; None: one
    ) -> Tensor | None:
        """[H, W, 3] or [3]: the gains of exposure and sunlight in ``view``; None: all are one."""
        light = light_over(view, self.columns, exposure) if self.columns else None
        return exposure if light is None else light


@torch.no_grad()
def learn_light(
    view: View,
    drawn: Tensor,  # [H, W, 3] the map from this view, in even light
    alpha: Tensor,  # [H, W]
    exposure: Tensor | None = None,  # [3] gain of the view
) -> None:
    """Set the light of ``view``, as fine as any, to what makes the map, so exposed, look like its
    picture."""
    grid = (slice(None, None, EVERY_PX), slice(None, None, EVERY_PX))
    ours, theirs = drawn[grid], view.target()[grid]
    ours = ours if exposure is None else ours * exposure
    good = ((alpha > SOLID) & view.scene_mask())[grid][..., None] & torch.isfinite(ours)
    layers = torch.cat([torch.where(good, ours, 0.0), theirs * good, good.to(ours.dtype)], dim=-1)
    cells = _means(layers.permute(2, 0, 1)[None], COLUMNS[-1])[0]
    ours, theirs, share = cells[:3], cells[3:6], cells[6:]
    ratio = ((theirs + DARK * share) / (ours + DARK * share).clamp_min(1e-6)).clamp_min(1e-6)
    found = (1.0 - TOWARDS_ONE) * ratio.log().clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN)
    before = torch.zeros_like(found) if view.light is None else view.light
    view.light = torch.where((share > LEAST_SHARE) & torch.isfinite(found), found, before)


def light_over(
    view: View,
    columns: int,
    exposure: Tensor | None = None,  # [3] gain of the view
) -> Tensor | None:
    """The gains [H, W, 3] of a view's pixels, between those of so many cells across; None where
    none were learned."""
    if view.light is None:
        return None
    cells = _coarsen(view.light[None], columns)[0].exp()
    cells = cells if exposure is None else cells * exposure[:, None, None]
    size = (view.camera.height, view.camera.width)
    # The channels last, as in a picture: the same numbers in two thirds of the time.
    cells = cells[None].contiguous(memory_format=torch.channels_last)
    return F.interpolate(cells, size, mode="bilinear")[0].permute(1, 2, 0)


def light_at(
    frame_index: int,
    views: Sequence[View],  # in the order of their frames
) -> Tensor | None:
    """[3, rows, columns] between the views before and after; None where none were learned."""
    known = [view for view in views if view.light is not None]
    if not known:
        return None
    at = float(np.interp(frame_index, [v.frame_index for v in known], np.arange(len(known))))
    before, after = known[int(at)].light, known[min(int(at) + 1, len(known) - 1)].light
    assert before is not None
    assert after is not None
    return torch.lerp(before, after, at - int(at))


def columns_of_light(
    views: Sequence[View],  # in the order of their frames
) -> int:
    """Cells across the picture of the finest light that the fields of ``views`` are; 0 if they are
    not worth their time, or neighbours do not predict them.

    Their mean is left out: what is the same in all pictures is the camera's shading.
    """
    known = [view.light for view in views if view.light is not None]
    if len(known) < FEWEST_VIEWS:
        return 0
    fields = torch.stack(known)
    fields = fields - fields.mean(dim=0)
    found, coarser = 0, torch.zeros_like(fields)
    for columns in COLUMNS:
        cells = _coarsen(fields, columns)
        added = cells - F.interpolate(coarser, cells.shape[-2:], mode="bilinear")
        energy = float(added[1:-1].square().mean())
        missed = float((added[1:-1] - 0.5 * (added[:-2] + added[2:])).square().mean())
        if missed >= (FINER_MISSED if found else MOST_MISSED) * energy:
            break
        if not found and energy <= LEAST_LIGHT**2:
            break
        found, coarser = columns, cells
    return found


def _coarsen(
    cells: Tensor,  # [V, 3, rows, columns]
    columns: int,
) -> Tensor:
    """Means over so many cells across, if they are fewer."""
    return cells if columns >= cells.shape[-1] else _means(cells, columns)


def _means(
    layers: Tensor,  # [V, C, H, W]
    columns: int,
) -> Tensor:
    """[V, C, rows, columns] over cells that are as wide as high."""
    rows = max(1, round(columns * layers.shape[-2] / layers.shape[-1]))
    return F.adaptive_avg_pool2d(layers, (rows, columns))
