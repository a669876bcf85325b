"""Held-out frames of a finished run: rendered, restored and compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import (
    RestoredPicture,
    common_exposure,
    restored_picture,
    to_bytes,
)
from aquaflow.mapping.transfers import picture_out
from aquaflow.mapping.views import View
from aquaflow.mapping.water.posed_picture import SOLID
from aquaflow.render.image_metrics import lpips, psnr, ssim
from aquaflow.slam import Slam

Rgb = list[float]


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
    lpips: float | None
    z: npt.NDArray[np.float32] | None = None
    """[H, W] rendered range, 0 where the map is not solid; map units unless something else is
    said."""
    confidence: npt.NDArray[np.uint8] | None = None
    """[H, W] 0 to 255, the share of ``restored`` that is the picture's (see RestoredPicture)."""
    amplification: npt.NDArray[np.float32] | None = None
    """[2, 3] RGB, as applied and as allowed (see RestoredPicture)."""


def examine_held_out(slam: Slam, sub_map: int) -> list[HeldOut]:
    """Render every held-out frame of a sub-map from its refined pose and compare."""
    mapper = slam.mappers.get(sub_map)
    if mapper is None or len(mapper.gaussians) == 0:
        return []
    views = sorted(slam.held_out.get(sub_map, []), key=lambda view: view.frame_index)
    contain, exposure = slam.failures.contain, 1.0
    for view in views:
        with contain("held-out pose", view.frame_index):
            mapper.register(view)
    with contain("restored exposure"):
        exposure = common_exposure(
            restored_picture(mapper.scene, view, mapper.show(view)).image for view in views
        )
    examined = []
    for view in views:
        with contain("evaluation", view.frame_index):
            examined.append(_examine(mapper, view, exposure))
    return examined


def _examine(mapper: Mapper, view: View, exposure: float) -> HeldOut:
    shown = mapper.show(view)
    real = picture_out(view.target())
    rendered = picture_out(shown.image.clamp(0.0, 1.0))
    restored: RestoredPicture | None = None
    if mapper.medium.active:
        restored = restored_picture(mapper.scene, view, shown)
    amplification = None if restored is None else restored.amplification
    perceptual, _ = lpips(rendered, real)
    return HeldOut(
        view.frame_index,
        view.image,
        to_bytes(rendered),
        None if restored is None else restored.picture_bytes(exposure),
        psnr(rendered, real),
        ssim(rendered, real),
        perceptual,
        picture_out(torch.where(shown.alpha > SOLID, shown.z, 0.0).to(torch.float32)),
        None if restored is None else restored.confidence_bytes(),
        None if amplification is None else picture_out(amplification),
    )


def mean_amplification(examples: Sequence[HeldOut]) -> tuple[Rgb, Rgb] | None:
    """Red, green, blue as applied and as allowed, mean over the views; None where none has any."""
    known = [each.amplification for each in examples if each.amplification is not None]
    if not known:
        return None
    mean = np.stack(known).astype(np.float64).mean(axis=0)
    return mean[0].tolist(), mean[1].tolist()
