"""An open device: what a camera's driver gives :class:`aquaflow.drivers.live.LiveCamera`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from aquaflow.types import CameraModel, EncodedPicture


class UnusablePictureError(Exception):
    """The bytes of one picture cannot be decoded; the message is the reason, after its number."""


def nothing_to_release() -> None:
    """For devices whose memory need not be returned."""


def no_file() -> None:
    """For devices that deliver pixels, not a picture file."""


@dataclass
class RawPicture:
    """One picture as the device delivered it; not decoded, since most that are dropped need not be.

    Its holder calls ``release`` exactly once, after the last use of what ``decode`` reads.
    """

    arrival_ns: int
    decode: Callable[[], npt.NDArray[np.uint8]]
    """[H, W, 3] RGB in memory of its own; raises UnusablePictureError."""
    exposed_ns: int | None = None
    """Moment of exposure that the device claims, CLOCK_MONOTONIC; None: it reports none."""
    device_ns: int | None = None
    """The same moment on the device's own clock, whose zero is arbitrary."""
    sequence: int | None = None
    """The device's picture counter, which also counts pictures that were never delivered."""
    stale: str = ""
    """Why it shows the past and must not be used, for people; empty: it may be."""
    exposure_s: float | None = None
    gain: float | None = None
    received: Callable[[], EncodedPicture | None] = no_file
    """The picture file that the device delivered, in memory of its own."""
    release: Callable[[], None] = nothing_to_release
    index: int = -1
    """Set by LiveCamera: position in the source."""
    t_ns: int = -1
    """Set by LiveCamera: the checked moment of exposure."""


class Capture(Protocol):
    """An open, streaming device. Used by one thread, but for ``release`` of its pictures."""

    camera: CameraModel | None
    """Calibration that the device itself carries."""
    format: str
    """What was agreed on with the device, such as ``1280 x 720 MJPG, 30 pictures/s``; empty where
    only its pictures tell."""
    notes: tuple[str, ...]
    """Requested settings that the device does not support; one sentence each."""

    def read(self, timeout_s: float) -> RawPicture | None:
        """The next picture; None when ``timeout_s`` passed without one.

        Raises:
            OSError: the device is gone; opening it again may bring it back.
        """
        ...

    def close(self) -> None:
        """Close the device; may be called again, and while pictures are not yet released."""
        ...


OpenCapture = Callable[[], Capture]
"""Opens the device, again and again; raises OSError with a sentence while it is not there."""
