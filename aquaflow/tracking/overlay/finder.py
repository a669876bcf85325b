"""Finds what a recorder burned into the pictures, by its staying where it is while the scene moves.

A vehicle that stands still shows nothing about overlays: only pictures in which most of the scene
has changed are looked at. What was found is tested again with every one of them, so a part of the
scene that stood still for long is given back as soon as the vehicle moves on. Pictures are looked
at no wider than ``WIDTH_PX``.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.tracking.overlay.regions import WIDTH_PX, Mask, overlay_regions
from aquaflow.tracking.overlay.static_structure import Float, StaticStructure, gradients
from aquaflow.types import Frame

THUMBNAIL_PX = 160
"""Width at which the scene is seen to move; a shift of 2 % of the width shows."""
TILES = (12, 9)
"""Columns and rows of tiles, each of which moved or did not."""
TEXTURED = 1.5
"""Grey levels per pixel of the thumbnail: a tile with less has nothing that could move."""
SAME = 0.5
"""Correlation of a tile's gradients from which it counts as not moved."""
CHANGED_SHARE = 0.6
"""Textured tiles that must have moved since the last sample."""
FIRST_SAMPLES = 3.5
"""Effective samples before anything is judged."""
MOST_SHARE = 0.4
"""Of the picture: more is no overlay."""


class OverlayFinder:
    """Masks overlays in the frames of one stream, in their order; deterministic."""

    def __init__(self) -> None:
        self.share = 0.0
        """Part of the picture that was masked last; 0 if no overlay was ever found."""
        self._static: StaticStructure | None = None
        self._hidden: Mask = np.zeros((0, 0), bool)
        self._shown: Mask | None = None
        self._last: tuple[Float, Float] | None = None

    @property
    def shown(self) -> Mask | None:
        """[H, W] what is no overlay, as far as is known by now; None: no overlay is known."""
        return self._shown

    def mask(self, frame: Frame) -> Frame:
        """The frame with its mask limited to what is no overlay."""
        if self._has_moved(frame.image):
            self._sample(frame)
        if self._shown is None:
            return frame
        shown = self._shown if frame.mask is None else self._shown & frame.mask
        return replace(frame, mask=shown)

    def _has_moved(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3]
    ) -> bool:
        """True if most of what is textured changed since the last sample."""
        height, width = image.shape[:2]
        size = (THUMBNAIL_PX, max(round(height * THUMBNAIL_PX / width), TILES[1]))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        new = gradients(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32))
        old, moved = self._last, True
        if old is not None:
            both, before, after = (
                cv2.resize(a[0] * b[0] + a[1] * b[1], TILES, interpolation=cv2.INTER_AREA)
                for a, b in ((old, new), (old, old), (new, new))
            )
            textured = np.minimum(before, after) > TEXTURED**2
            if self._hidden.any():
                hidden = cv2.resize(
                    self._hidden.astype(np.float32), TILES, interpolation=cv2.INTER_AREA
                )
                textured &= hidden < 0.25
            same = both[textured] > SAME * np.sqrt(before * after)[textured]
            moved = bool(same.size and 1.0 - same.mean() >= CHANGED_SHARE)
        if moved:
            self._last = new
        return moved

    def _sample(self, frame: Frame) -> None:
        height, width = frame.image.shape[:2]
        grey = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        if width > WIDTH_PX:
            size = (WIDTH_PX, round(height * WIDTH_PX / width))
            grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))
        if self._static is None:
            self._static = StaticStructure((grey.shape[0], grey.shape[1]))
            self._hidden = np.zeros(grey.shape, bool)
        self._static.add(grey.astype(np.float32))
        if self._static.samples < FIRST_SAMPLES:
            return
        hidden = overlay_regions(self._static, self._hidden)
        if hidden.mean() > MOST_SHARE:
            hidden = np.zeros_like(hidden)
        self._hidden, share = hidden, float(hidden.mean())
        self.share = share or self.share
        full = cv2.resize(hidden.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        self._shown = np.asarray(full == 0) if share > 0.0 else None
