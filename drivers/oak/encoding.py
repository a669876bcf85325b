"""How pictures come from an OAK: whole, with less colour, or as JPEG, by what its link carries.

Bytes a second are those of the pictures; the figures of links are what is left of their nominal
rate for one camera beside the IMU.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

from aquaflow.config.cameras import OakConfig

Encoding: TypeAlias = Literal["bgr", "nv12", "mjpeg"]

BYTES_PER_PIXEL: dict[Encoding, float] = {"bgr": 3.0, "nv12": 1.5}
"""Of those that are not compressed, the best first. NV12 has one colour for four pixels, as the
sensor's own mosaic and every JPEG do."""

LINK_BYTES_S = {
    "SUPER_PLUS": 300e6,
    "SUPER": 300e6,
    "HIGH": 28e6,
    "UNKNOWN": 60e6,
}
"""By the name of ``dai.UsbSpeed``: USB 3 of 5 Gbit/s, USB 2 of 480 Mbit/s, of which some 35 MB/s
arrive; UNKNOWN is a camera on the network, whose own port has 1 Gbit/s. Slower than all of these
are USB 1's LOW and FULL."""
SLOWEST_BYTES_S = 1e6

NAMES = {"SUPER_PLUS": "USB 3", "SUPER": "USB 3", "HIGH": "USB 2", "UNKNOWN": "the network"}

JPEG_QUALITY = 95
"""Percent; a tenth of BGR's bytes, and finer than what tracking sees."""


def chosen(config: OakConfig, speed: str) -> Encoding:
    """As configured, else the best that a link of this ``dai.UsbSpeed`` carries."""
    if config.encoding != "auto":
        return config.encoding
    room = LINK_BYTES_S.get(speed, SLOWEST_BYTES_S)
    for encoding, size in BYTES_PER_PIXEL.items():
        if _rate(config, size) <= room:
            return encoding
    return "mjpeg"


def said(config: OakConfig, speed: str, encoding: Encoding) -> str:
    """The choice in words, for the log."""
    link = NAMES.get(speed, "USB 1")
    raw = _rate(config, BYTES_PER_PIXEL["bgr"]) * 1e-6
    return f"on {link}; pictures come as {encoding.upper()} (BGR would be {raw:.0f} MB/s)"


def _rate(config: OakConfig, bytes_per_pixel: float) -> float:
    """Bytes a second."""
    return config.width * config.height * config.fps * bytes_per_pixel
