"""The pictures that the map is optimised against."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from aquaflow.base.storage.archive import Arrays
from aquaflow.base.storage.spill import Spill
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.render.contract import CPU
from aquaflow.render.transfers import frame_in, pointmap_in, pose_in, pose_out

RESIDENT_VIEWS = 128
"""Views in memory while the others are in files; at most 1.4 MB each at 480 x 270 px. Any view may
be the next to be optimised against, so that more of them save few reads."""


@dataclass(frozen=True)
class Pixels:
    """The per-pixel data of a view, on the host."""

    image: npt.NDArray[np.uint8]
    """[H, W, 3] RGB."""
    mask: npt.NDArray[np.bool_] | None = None
    """[H, W], True where the picture shows the scene."""
    inverse_range: Tensor | None = None
    """[H, W] 1 / range."""
    range_confidence: Tensor | None = None
    """[H, W] in [0, 1]."""
    copies: dict[str, Tensor] = field(default_factory=dict, repr=False, compare=False)
    """Of the above by name, on the map's device, made when first asked for; none on the CPU."""

    def on(self, device: torch.device, name: str) -> Tensor | None:
        """The array ``name`` on ``device``; None where there is none."""
        host = getattr(self, name)
        if host is None:
            return None
        if device.type == "cpu":
            self.copies.clear()
            return torch.from_numpy(host) if isinstance(host, np.ndarray) else host
        if name not in self.copies:
            moved = frame_in if isinstance(host, np.ndarray) else pointmap_in
            self.copies[name] = moved(host, device)
        return self.copies[name]


class View:
    """One posed picture; its pixels are in a ``ViewStore`` once they were added to one."""

    def __init__(
        self,
        frame_index: int,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
        camera: CameraModel,
        T_wc: Sim3,
        keyframe: int,
        robust: bool,
        mask: npt.NDArray[np.bool_] | None = None,  # [H, W]
        device: torch.device = CPU,
    ) -> None:
        """``device``: that of the map which the view is drawn from; ``begin_on`` changes it."""
        self.frame_index, self.camera, self.T_wc = frame_index, camera, T_wc
        self.keyframe = keyframe
        """Number of the keyframe that the pose is relative to."""
        self.robust = robust
        """True for common frames, whose outliers are masked (paper, M)."""
        self.looks = 0
        """Optimiser steps on this view."""
        self.moments = (np.zeros(6), np.zeros(6), 0)
        """Adam's first and second moments of the pose, and its step count."""
        self._store: dict[int, Pixels] | Spill[Pixels] = {frame_index: Pixels(image, mask)}
        self.begin_on(device)

    def begin_on(self, device: torch.device) -> None:
        """Be a view of a map on ``device``, of whose light nothing was learned yet."""
        self.device = device
        """Where the tensors of this view are; its pictures are taken there as they are used."""
        self.log_gain = torch.zeros(3, dtype=torch.float64, device=device)
        """[3] how much brighter than the mean of the views, RGB (see water/exposure.py)."""
        self.light: Tensor | None = None
        """[3, rows, columns] log-gain of the sunlight over the picture (see water/sunlight.py)."""
        self.explained: Tensor | None = None
        """[rows, columns] bool, the tiles in which the last full look found nothing but noise."""
        self.all_explained: bool | None = None
        """Whether those are all that show the scene; None while nobody has asked."""

    def with_pixels(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
        camera: CameraModel,
        mask: npt.NDArray[np.bool_] | None,  # [H, W]
    ) -> View:
        """The same frame, of which nothing was learned yet, in another picture of it."""
        return View(
            self.frame_index, image, camera, self.T_wc, self.keyframe, self.robust, mask
        )  # fmt: skip

    def move_pixels(self, store: Spill[Pixels]) -> None:
        """Move the pixels into ``store``, under the frame's index."""
        store[self.frame_index] = self._pixels
        self._store = store

    def use_store(self, store: Spill[Pixels]) -> None:
        """Take the pixels from ``store``, which has them under the frame's index."""
        self._store = store

    def is_stored_in(self, store: Spill[Pixels]) -> bool:
        """True while its pixels are in ``store``."""
        return self._store is store and self.frame_index in store

    @property
    def has_pixels(self) -> bool:
        """False once they were deleted."""
        return self.frame_index in self._store

    def delete_pixels(self) -> None:
        """Delete the pixels; the view must not be used afterwards."""
        del self._store[self.frame_index]

    @property
    def _pixels(self) -> Pixels:
        return self._store[self.frame_index]

    def _change(self, **arrays: Any) -> None:
        pixels = self._pixels
        unchanged = {name: copy for name, copy in pixels.copies.items() if name not in arrays}
        self._store[self.frame_index] = replace(pixels, copies=unchanged, **arrays)

    @property
    def image(self) -> npt.NDArray[np.uint8]:
        """[H, W, 3] RGB."""
        return self._pixels.image

    @property
    def mask(
        self,
    ) -> npt.NDArray[np.bool_] | None:
        """[H, W], True where the picture shows the scene; to change it, set it."""
        return self._pixels.mask

    @mask.setter
    def mask(
        self,
        mask: npt.NDArray[np.bool_] | None,  # [H, W]
    ) -> None:
        self._change(mask=mask)

    @property
    def inverse_range(
        self,
    ) -> Tensor | None:
        """[H, W] 1 / range from tracking, in the keyframe's unit: T_wc.scale makes it the world's.
        0 where unknown. On the map's device; it is set from the host."""
        return self._pixels.on(self.device, "inverse_range")

    @inverse_range.setter
    def inverse_range(
        self,
        inverse_range: Tensor | None,  # [H, W]
    ) -> None:
        self._change(inverse_range=inverse_range)

    @property
    def range_confidence(
        self,
    ) -> Tensor | None:
        """[H, W] in [0, 1], as :attr:`inverse_range`."""
        return self._pixels.on(self.device, "range_confidence")

    @range_confidence.setter
    def range_confidence(
        self,
        range_confidence: Tensor | None,  # [H, W]
    ) -> None:
        self._change(range_confidence=range_confidence)

    def target(self) -> Tensor:
        """[H, W, 3] float32 in [0, 1]."""
        picture = self._pixels.on(self.device, "image")
        assert picture is not None
        return picture.to(torch.float32).div_(255.0)

    def scene_mask(self) -> Tensor:
        """[H, W] bool, a fresh one: True where the view shows the scene and not the vehicle."""
        mask = self._pixels.on(self.device, "mask")
        if mask is None:
            size = (self.camera.height, self.camera.width)
            return torch.ones(size, dtype=torch.bool, device=self.device)
        return mask.clone()

    def world_to_camera(self) -> npt.NDArray[np.float64]:
        """[4, 4] rigid: the scale of a pose is the scale of its map."""
        R = self.T_wc.R.T
        V = np.eye(4)
        V[:3, :3], V[:3, 3] = R, -R @ self.T_wc.t
        return V

    def viewmat(self) -> Tensor:
        """[4, 4] float32 :meth:`world_to_camera`, on the map's device."""
        return pose_in(self.world_to_camera(), self.device)

    def centre(self) -> Tensor:
        """[3] float32 place of the camera in the world, on the map's device."""
        return pose_in(self.T_wc.t, self.device)

    def K(self) -> Tensor:
        """[3, 3] float32 intrinsics, px, on the map's device."""
        return pose_in(self.camera.K, self.device)


def in_time(views: Iterable[View]) -> list[View]:
    """The views in the order of their frames; the first views of a map come in another."""
    return sorted(views, key=lambda view: view.frame_index)


class ViewStore:
    """Store of the pixels of a dive's views: the last used in memory, the others, with a work
    folder, in its ``views`` folder. They are restored bit for bit."""

    def __init__(self, work: Path | None = None, resident: int = RESIDENT_VIEWS) -> None:
        folder = None if work is None else work / "views"
        self._pixels = Spill(folder, resident, _pack, _unpack)
        self.lost: set[int] = set()
        """Frame indices of the views that :meth:`restore` found no file of."""

    def keep(self, view: View) -> View:
        """Take over the view's pixels; no other view of the dive may have its frame index."""
        view.move_pixels(self._pixels)
        return view

    def save(self) -> list[Path]:
        """Write what is only in memory; the files that are new."""
        return self._pixels.save()

    def restore(self, views: Sequence[View]) -> list[View]:
        """Give views the pixels that an earlier run saved; returns the views that have them, which
        excludes views deleted later and views whose file is lost."""
        known = [view for view in views if self._pixels.restore(view.frame_index)]
        for view in known:
            view.use_store(self._pixels)
        removed = self._pixels.removed_numbers()
        there = {view.frame_index for view in known}
        self.lost |= {view.frame_index for view in views} - there - removed
        return known

    def holds(self, view: View) -> bool:
        """True if this store has the view's pixels."""
        return view.is_stored_in(self._pixels)

    def drop_copies(self) -> None:
        """Free the copies on the map's device; they are made anew as they are used."""
        for pixels in self._pixels.in_memory:
            pixels.copies.clear()

    @property
    def resident_bytes(self) -> int:
        """Size of the pixels in memory."""
        return self._pixels.resident_bytes

    def close(self, keep: bool = False) -> None:
        """Remove the files; or, to ``keep`` them, write what is only in memory too."""
        self._pixels.close(keep)


def _pack(pixels: Pixels) -> Arrays:
    arrays = {"image": pixels.image, "mask": pixels.mask}
    ranges = {"inverse_range": pixels.inverse_range, "range_confidence": pixels.range_confidence}
    arrays |= {name: None if values is None else values.numpy() for name, values in ranges.items()}
    return {name: array for name, array in arrays.items() if array is not None}


def _unpack(
    number: int,
    arrays: Arrays,  # as from _pack
) -> Pixels:
    inverse_range, confidence = (
        torch.from_numpy(arrays[name]) if name in arrays else None
        for name in ("inverse_range", "range_confidence")
    )
    return Pixels(arrays["image"], arrays.get("mask"), inverse_range, confidence)


BETAS = (0.8, 0.99)
"""Adam's decay rates for poses (docs/paper.md#published-values)."""


def is_usable(
    gradient: npt.NDArray[np.float64],  # [4, 4]
) -> bool:
    """True if a pose may be moved by this gradient: one NaN would stay in it."""
    return bool(np.isfinite(gradient[:3]).all())


def refine_pose(
    view: View,
    gradient: Tensor,  # [4, 4] of the loss with respect to the view matrix
    rate: float,
) -> None:
    """One Adam step of the view's pose on the group; translation moves in units of the map.

    The view matrix V moves by the left tangent: dV = hat(xi) V, so dL/dxi_k = <G, E_k V>.
    """
    V = view.world_to_camera().astype(np.float32).astype(np.float64)  # as it was drawn
    G = pose_out(gradient).astype(np.float64)
    if not is_usable(G):
        return
    M = G[:3] @ V.T
    g = np.array(
        [M[0, 3], M[1, 3], M[2, 3], M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]
    )
    m, v, count = view.moments
    count += 1
    m = BETAS[0] * m + (1.0 - BETAS[0]) * g
    v = BETAS[1] * v + (1.0 - BETAS[1]) * g * g
    step = (
        -rate * (m / (1.0 - BETAS[0] ** count)) / (np.sqrt(v / (1.0 - BETAS[1] ** count)) + 1e-15)
    )
    R_cw = so3_exp(step[3:]) @ V[:3, :3]
    t_cw = so3_exp(step[3:]) @ V[:3, 3] + step[:3]
    # so3_exp(log(R)) puts the product back on the group.
    pose = Sim3(R_cw.T, -R_cw.T @ t_cw, view.T_wc.scale)
    view.T_wc = (pose @ Sim3.identity()).if_finite()
    view.moments = (m, v, count)
