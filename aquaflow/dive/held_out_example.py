"""One held-out frame as it was examined: pictures and numbers on the host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Rgb = list[float]


class Fidelity(NamedTuple):
    """How like the camera's picture a drawing is."""

    psnr: float
    """dB"""
    ssim: float


class Perceived(NamedTuple):
    """How far apart the two look to a person; None of what cannot be measured here."""

    flip: float | None
    """aquaflow/render/image_metrics.py"""
    lpips: float | None
    lpips_alex: float | None
    """By the features of VGG and of AlexNet (aquaflow/render/lpips.py)."""


@dataclass(frozen=True)
class HeldOut:
    """One held-out frame after its pose was refined."""

    frame_index: int
    real: npt.NDArray[np.uint8]
    rendered: npt.NDArray[np.uint8]
    restored: npt.NDArray[np.uint8] | None
    """[H, W, 3], or [H, W, 4] with alpha where open water was removed."""
    psnr: float
    ssim: float
    perceived: Perceived
    z: npt.NDArray[np.float32] | None = None
    """[H, W] rendered range, 0 where the map is not solid; map units unless something else is
    said."""
    confidence: npt.NDArray[np.uint8] | None = None
    """[H, W] 0 to 255, the share of ``restored`` that is the picture's (see RestoredPicture)."""
    amplification: npt.NDArray[np.float32] | None = None
    """[2, 3] RGB, as applied and as allowed (see RestoredPicture)."""
    as_tracked: Fidelity | None = None
    """Before its own picture refined its pose: as tracked, moved with the views before and after,
    whose exposure and light it has."""


def mean_amplification(examples: Sequence[HeldOut]) -> tuple[Rgb, Rgb] | None:
    """Red, green, blue as applied and as allowed, mean over the views; None where none has any."""
    known = [each.amplification for each in examples if each.amplification is not None]
    if not known:
        return None
    mean = np.stack(known).astype(np.float64).mean(axis=0)
    return mean[0].tolist(), mean[1].tolist()
