"""What a live camera says of itself: its state, and where its pictures went."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class CameraState(Enum):
    """States of a camera from unplugged to delivering pictures."""

    CLOSED = "closed"
    CONNECTING = "connecting"
    STREAMING = "streaming"
    LATE = "late"
    """Its pictures are too old to be used, or of unknown age."""
    LOST = "lost"


@dataclass
class CameraCounters:
    """Pictures since the source was made; every received one ends in exactly one other counter,
    but for the one that may be waiting or held by the consumer."""

    received: int = 0
    delivered: int = 0
    overtaken: int = 0
    """A newer one came before the consumer took it."""
    passed_over: int = 0
    """Not asked for: sub-sampling."""
    stale: int = 0
    """Too old when it came, or of unknown age, by the time that a stream itself carries."""
    unusable: int = 0
    """Damaged, or of another size than those before."""
    duplicates: int = 0
    lost: int = 0
    """Never received: gaps in the device's own counter."""
    stamps_repaired: int = 0
    reconnects: int = 0
