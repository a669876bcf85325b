"""How much brighter each view is than the others: auto-exposure, lamps that dim, the sun.

One gain per channel multiplies the whole picture, water included. Against a map that is drawn
already it needs no gradient: it is the median ratio of the picture to the drawing, known at once.
The mean over the views is held near one, else bright views and dark points could trade for ever.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.render.transfers import water_in, water_out
from aquaflow.render.views import View

Array = npt.NDArray[np.float64]

SAMPLES = 8000
"""Pixels looked at, on a grid: their median is known to 0.1 % where single ones differ by 10 %."""
FEWEST = 60
"""Usable pixels of a channel below which its gain stays what it was."""
SOLID = 0.9
"""Alpha above which the drawing says something about the picture."""
DARKEST, BRIGHTEST = 0.02, 0.98
"""Colours outside are rounded too coarsely, or clipped."""
TOWARDS_ONE = 0.01
"""Share of a log-gain that is taken back each time: the weak pull that holds their mean."""
MAX_LOG_GAIN = 2.0
"""Guards the exponential: seven times brighter or darker shows nothing any more."""


def gain_of(view: View) -> Tensor:
    """[3] of a view."""
    return view.log_gain.exp().to(torch.float32)


def log_gains_of(views: Sequence[View]) -> Array:
    """[V, 3] on the host."""
    return water_out(torch.stack([view.log_gain for view in views]))


@torch.no_grad()
def learn_gain(
    view: View,
    drawn: Tensor,  # [H, W, 3] the map from this view, at gain one
    alpha: Tensor,  # [H, W]
) -> None:
    """Set the gain of ``view`` to what makes the map look like its picture."""
    step = max(1, round((alpha.numel() / SAMPLES) ** 0.5))
    grid = (slice(step // 2, None, step), slice(step // 2, None, step))
    ours, theirs = drawn[grid].reshape(-1, 3), view.target()[grid].reshape(-1, 3)
    good = ((alpha > SOLID) & view.scene_mask())[grid].reshape(-1, 1)
    for colour in (ours, theirs):
        good = good & (colour > DARKEST) & (colour < BRIGHTEST)
    ratio = theirs.clamp_min(DARKEST) / ours.clamp_min(DARKEST)
    median = torch.where(good, ratio.log(), torch.nan).nanmedian(dim=0).values
    found = (1.0 - TOWARDS_ONE) * median.double()
    enough = (good.sum(dim=0) >= FEWEST) & torch.isfinite(found)
    view.log_gain = torch.where(enough, found.clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN), view.log_gain)


def log_gain_at(
    frame_index: int,
    views: Sequence[View],  # in the order of their frames
) -> Array:
    """[3] between the views before and after, as a view that was never mapped is shown."""
    after = bisect(views, frame_index, key=lambda view: view.frame_index)
    around = views[max(after - 1, 0) : after + 1]
    return _between(frame_index, around, log_gains_of(around))


def set_log_gains(
    views: Sequence[View],
    fitted: Sequence[View],  # some of them, in the order of their frames
    log_gains: Array,  # [up to len(fitted), 3]
) -> None:
    """Give the fitted views their gains, and all others what changes between them; so too the last
    of those fitted where nothing was sighted in them."""
    fitted = fitted[: len(log_gains)]
    change = log_gains - log_gains_of(fitted)
    before = log_gains_of(views)
    moved = [
        log_gain + _between(view.frame_index, fitted, change)
        for view, log_gain in zip(views, before, strict=True)
    ]
    if not np.isfinite(moved).all():
        raise ArithmeticError("an exposure is not finite")
    for view, log_gain in zip(views, moved, strict=True):
        set_log_gain(view, log_gain)


def set_log_gain(
    view: View,
    log_gain: Array,  # [3]
) -> None:
    """Give ``view`` this exposure."""
    view.log_gain = water_in(log_gain, view.device, torch.float64)


def _between(
    frame_index: int,
    views: Sequence[View],  # V, in the order of their frames
    values: Array,  # [V, 3] log-gain of RGB
) -> Array:
    at = [view.frame_index for view in views]
    return np.array([np.interp(frame_index, at, values[:, c]) for c in range(3)])
