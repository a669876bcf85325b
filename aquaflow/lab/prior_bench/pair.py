"""A pair of pictures with what is known to be true of it, and the matches that a method found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.prior.contract import Float, Mask

Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class KnownPair:
    """Two pictures; at least one of ``truth`` and ``T_ba`` is known."""

    group: str
    """Pairs that are averaged together."""
    a: Picture
    """[H, W, 3] RGB"""
    b: Picture
    camera_a: CameraModel
    camera_b: CameraModel
    truth: Float | None = None
    """[H, W, 2] px: where each pixel of a is in b."""
    visible: Mask | None = None
    """[H, W]: b shows the true match."""
    T_ba: Sim3 | None = None
    """From a's frame to b's; of any scale."""

    @property
    def judged_by(self) -> str:
        """``pixel``, or ``line`` where only the epipolar line of a match is known."""
        return "line" if self.truth is None else "pixel"


@dataclass(frozen=True)
class FoundMatches:
    """Pixels of a and of b that show the same thing, as a method says."""

    pixels_a: Float
    """[M, 2] px"""
    pixels_b: Float
    """[M, 2] px"""
    textured: Mask | None = None
    """[H, W]: pixels of a that a dense method may be expected to match; None for a sparse one."""
