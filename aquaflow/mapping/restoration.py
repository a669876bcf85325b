"""A view's picture without its water."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.mapping.rendering import Shown
from aquaflow.mapping.scene import Scene
from aquaflow.mapping.views import View

SOLID = 0.5
"""Alpha above which the map's range is that of the picture."""
BRIGHT_QUANTILE, BRIGHT_LEVEL = 0.995, 0.95
"""This share of the restored values is shown no brighter than this level."""


@torch.no_grad()
def restored_picture(scene: Scene, view: View, shown: Shown) -> Tensor:
    """The picture [H, W, 3] without water, at the ranges that the map ``shown`` from the view has,
    in the white balance that the camera had for what was nearest (see water/white_balance.py).

    Where the vehicle is in the picture, the map's own radiance. J-hat keeps the detail that the map
    has lost: on synthetic dives it is 5 dB closer to the clean scene than the map's radiance
    everywhere. Open water, where the map has nothing, is black, or as the camera saw it
    (``medium.open_water``).
    """
    picture = scene.recovered(view, shown.z)
    radiance = scene.balanced(shown.radiance)
    usable = (shown.alpha > SOLID) & view.scene_mask()
    restored = torch.where(usable[..., None], picture, radiance)
    if scene.config.open_water == "kept":
        through = ((1.0 - shown.alpha) * ~usable)[..., None]
        restored = restored + through * scene.evenly_lit(view)
    return restored


def common_exposure(
    pictures: Iterable[Tensor],  # each [H, W, 3]
) -> float:
    """One gain for all restored pictures, so that the bright end of the dive is not cut off.

    Without water a scene may be brighter than the camera's white; 1 where it is not.
    """
    brightest = max((float(np.quantile(p.numpy(), BRIGHT_QUANTILE)) for p in pictures), default=0.0)
    return min(1.0, BRIGHT_LEVEL / max(brightest, 1e-6))


def to_bytes(
    image: npt.NDArray[np.floating],  # [H, W, 3]
) -> npt.NDArray[np.uint8]:
    """[H, W, 3] in [0, 1] as 8-bit."""
    return np.asarray(np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
