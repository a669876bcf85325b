"""The frame gate: useless pictures are skipped before any costly processing."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from aquaflow.config import GateConfig
from aquaflow.tracking.gate.thumbnail import (
    Float,
    Mask,
    Thumbnail,
    measure_thumbnail,
    motion_widths,
)

FIRST_LEVELS = 3
"""Frames before sharpness has a level to fall from."""
DUPLICATE_WIDTHS = 0.3 / 480.0
"""Motion over width below which a frame is a duplicate; 0.3 px at 480 px is what a checked DIS
match is known to."""
STATIC_SHARE = 0.8
"""Part of the textured tiles that must stand still; fish move in the others."""
MIN_SNR = 2.0
"""Gradient of a textured tile over that of noise alone; measured: below 1.2 to 1.8 in the
median tile, flow finds no more than chance matches."""
MIN_USABLE = 0.05
"""Textured share of the picture that a pose can come from."""
DARK_LEVEL = 20.0
"""Grey level that separates dark from blinded, in the reason."""
BLUR_LOSS = 0.065
"""Sharpness left, of the running median; measured at 480 px: Gaussian blur of 5 px leaves 0.07
to 0.09 and still tracks, 8 px 0.04 to 0.06 and does not; good frames keep over 0.69."""
BLUR_MEMORY = 9
"""Frames that the running sharpness is taken from."""


class GateKind(str, Enum):
    """The gate's classes of frames."""

    PASS = "pass"
    DUPLICATE = "duplicate"
    DARK = "dark"
    BLURRED = "blurred"
    BLINDED = "blinded"


@dataclass(frozen=True)
class GateVerdict:
    """Whether a frame is tracked, and the measure that decided it."""

    kind: GateKind
    reason: str = ""
    """One clause for the dive's records; empty for an ordinary pass."""
    measure: float = float("nan")
    """For a duplicate and for an ordinary pass the motion in picture widths: infinite beyond some
    pixels, NaN without a frame to compare with. For dark and blinded the textured share of the
    picture; for blurred the sharpness over its running level."""

    @property
    def passed(self) -> bool:
        """True if the frame is tracked."""
        return self.kind is GateKind.PASS

    @property
    def same_place(self) -> bool:
        """True if the frame shows what the last one that passed showed."""
        return self.kind is GateKind.DUPLICATE


class FrameGate:
    """Judges frames in the order of the stream; the same frames get the same verdicts."""

    def __init__(self, config: GateConfig) -> None:
        self._config = config
        self._reference: Thumbnail | None = None
        self._levels: deque[Float] = deque(maxlen=BLUR_MEMORY)
        self._run = 0

    def judge(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
        mask: Mask | None = None,  # [H, W] True where the scene is seen
    ) -> GateVerdict:
        """The verdict on the next frame of the stream.

        Of frames that show nothing, only ``longest_run`` in a row are skipped; the following ones
        pass until one is good again: the tracker has to know that it sees nothing.
        """
        thumbnail = measure_thumbnail(image, mask, MIN_SNR)
        verdict = self._useless(thumbnail)
        if verdict is not None:
            return self._bound(verdict)
        self._run = 0
        verdict = self._compare(thumbnail)
        if verdict.passed:
            self._reference = thumbnail
            self._levels.append(thumbnail.sharpness)
        return verdict

    def forget(self) -> None:
        """Call when tracking lost the frame: later frames are no duplicates of it."""
        self._reference = None

    def _useless(self, thumbnail: Thumbnail) -> GateVerdict | None:
        """Dark, blinded or blurred; None for a picture that shows something."""
        config = self._config
        if thumbnail.usable < MIN_USABLE:
            says = f"texture above the noise in {100 * thumbnail.usable:.0f} % of the picture"
            dark = thumbnail.level < DARK_LEVEL
            if dark and config.skip_dark:
                return GateVerdict(GateKind.DARK, f"dark: {says}", thumbnail.usable)
            if not dark and config.skip_blinded:
                return GateVerdict(GateKind.BLINDED, f"blinded: {says}", thumbnail.usable)
            return None
        if not config.skip_blurred or len(self._levels) < FIRST_LEVELS:
            return None
        usual = np.median(np.stack(self._levels), axis=0)
        left = float((thumbnail.sharpness / np.maximum(usual, 1e-6)).min())
        if left >= BLUR_LOSS:
            return None
        return GateVerdict(
            GateKind.BLURRED, f"blurred: {100 * left:.0f} % of the usual sharpness", left
        )

    def _bound(self, verdict: GateVerdict) -> GateVerdict:
        self._run += 1
        if self._run <= self._config.longest_run:
            return verdict
        # From here on nothing that came before is a measure for what comes: water may have changed.
        self._reference = None
        self._levels.clear()
        reason = f"{verdict.reason}; {self._config.longest_run} such frames were skipped before it"
        return GateVerdict(GateKind.PASS, reason, verdict.measure)

    def _compare(self, thumbnail: Thumbnail) -> GateVerdict:
        """Against the last frame that passed, so that slow drift adds up until it is seen."""
        if not self._config.skip_duplicates or self._reference is None:
            return GateVerdict(GateKind.PASS)
        motion = motion_widths(self._reference, thumbnail, STATIC_SHARE)
        if motion >= DUPLICATE_WIDTHS:
            return GateVerdict(GateKind.PASS, measure=motion)
        reason = f"duplicate: moved by {100 * motion:.3f} % of the width since the last frame used"
        return GateVerdict(GateKind.DUPLICATE, reason, motion)
