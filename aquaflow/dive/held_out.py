"""Held-out frames of a finished run: rendered, restored and compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.dive.held_out_example import Fidelity, HeldOut, Perceived
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.appearance import shown_tone
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.restoration import (
    RestoredPicture,
    restored_picture,
    to_bytes,
)
from aquaflow.mapping.scene import RenderedMap
from aquaflow.render.image_metrics import flip, psnr, ssim
from aquaflow.render.lpips import load_lpips
from aquaflow.render.transfers import picture_out
from aquaflow.render.views import View, in_time
from aquaflow.slam import Slam
from aquaflow.water.sightings import SOLID
from aquaflow.water.tone import ShownTone

REGISTERING = 0.85
"""Of the time for held-out views, for their poses: a dozen drawings each, where comparing takes a
few (notes/2026-11-speed.md#finishing)."""


def examine_held_out(
    slam: Slam,
    sub_map: int,
    poses: Mapping[int, Sim3],
    until: Deadline | None = None,
) -> list[HeldOut]:
    """Render every held-out frame of a sub-map from its refined pose and compare; where there is
    only time for some ``until`` then, those are spread over the dive.

    ``poses``: T_wc by frame index that they start from, for those that it has.
    """
    mapper = slam.mappers.get(sub_map)
    if mapper is None or len(mapper.gaussians) == 0:
        return []
    views = in_time(slam.held_out.get(sub_map, []))
    for view in views:
        view.T_wc = poses.get(view.frame_index, view.T_wc)
    contain, tone = slam.failures.contain, ShownTone()
    views, as_tracked = _register_views(slam, mapper, views, until or Deadline())
    with contain("restored tone"):
        tone = shown_tone(mapper)
    examined = []
    for view in views:
        with contain("evaluation", view.frame_index):
            before = as_tracked.get(view.frame_index)
            examined.append(replace(_examine(mapper, view, tone), as_tracked=before))
    return examined


def _pictures(
    view: View, shown: RenderedMap
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """[H, W, 3] of the map and of the camera."""
    return picture_out(shown.image.clamp(0.0, 1.0)), picture_out(view.target())


def _fidelity(view: View, shown: RenderedMap) -> Fidelity:
    rendered, real = _pictures(view, shown)
    return Fidelity(psnr(rendered, real), ssim(rendered, real))


def _register_views(
    slam: Slam, mapper: Mapper, views: Sequence[View], until: Deadline
) -> tuple[list[View], dict[int, Fidelity]]:
    """Refine the poses of the ``views``; those that there was time for, in their order, and how
    like they were before, by frame index."""
    registering, done = until.share(REGISTERING), list[int]()
    as_tracked: dict[int, Fidelity] = {}
    for place in spread(len(views)):
        if registering.over:
            break
        view = views[place]
        with slam.failures.contain("held-out pose", view.frame_index):
            mapper.take_light(view)
            as_tracked[view.frame_index] = _fidelity(view, mapper.show(view))
            mapper.register(view)
        done.append(place)
    return [views[place] for place in sorted(done)], as_tracked


def spread(count: int) -> list[int]:
    """0 to ``count`` - 1 in an order whose every beginning is spread over all of them: that of
    their binary digits read backwards (van der Corput's sequence)."""
    digits = max(count - 1, 1).bit_length()
    return sorted(range(count), key=lambda place: f"{place:0{digits}b}"[::-1])


def _examine(mapper: Mapper, view: View, tone: ShownTone) -> HeldOut:
    shown = mapper.show(view)
    rendered, real = _pictures(view, shown)
    restored: RestoredPicture | None = None
    if mapper.medium.active:
        restored = restored_picture(mapper.scene, view, shown)
    amplification = None if restored is None else restored.amplification
    return HeldOut(
        view.frame_index,
        view.image,
        to_bytes(rendered),
        None if restored is None else restored.picture_bytes(tone),
        psnr(rendered, real),
        ssim(rendered, real),
        _perceived(mapper, rendered, real),
        picture_out(torch.where(shown.alpha > SOLID, shown.z, 0.0).to(torch.float32)),
        None if restored is None else restored.confidence_bytes(),
        None if amplification is None else picture_out(amplification),
    )


def _perceived(
    mapper: Mapper,
    rendered: npt.NDArray[np.float32],  # [H, W, 3]
    real: npt.NDArray[np.float32],  # [H, W, 3]
) -> Perceived:
    networks, _ = load_lpips(mapper.config.lpips_weights)
    by = {name: network(rendered, real) for name, network in networks.items()}
    return Perceived(flip(rendered, real), by.get("vgg"), by.get("alex"))
