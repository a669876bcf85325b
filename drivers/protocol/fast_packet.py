"""Messages of NMEA 2000 that take several frames of a CAN bus (fast packets).

The first byte of each frame holds the number of the message (3 bits) and of the frame (5 bits); the
second byte of frame 0 holds the length in bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

FRAME_BITS = 5
FIRST_DATA, NEXT_DATA = 2, 1
"""Bytes before the data in frame 0, and in those after it."""
LONGEST = 223
"""Bytes: 6 of frame 0 and 7 of each of 31 more."""


@dataclass
class _Open:
    """A message of which frames are missing."""

    number: int
    length: int
    frames: int
    data: bytearray = field(default_factory=bytearray)


class FastPackets:
    """Puts the messages of each sender together; one that lacks a frame is dropped whole."""

    def __init__(self) -> None:
        self._open: dict[int, _Open] = {}

    def add(self, identifier: int, data: bytes) -> bytes | None:
        """The message that the frame ``data`` completes; ``identifier`` names group and sender.

        Raises:
            ValueError: a frame is missing, or states an impossible length.
        """
        number, frame = data[0] >> FRAME_BITS, data[0] & (1 << FRAME_BITS) - 1
        if frame == 0:
            if not 0 < data[1] <= LONGEST:
                raise ValueError("a fast packet states a length that it cannot have")
            message = _Open(number, data[1], 0)
            part = data[FIRST_DATA:]
        else:
            message = self._open.pop(identifier, _Open(number, 0, 0))
            if message.length == 0 or (message.number, message.frames) != (number, frame):
                raise ValueError("a frame of a fast packet is missing")
            part = data[NEXT_DATA:]
        message.data += part
        message.frames = frame + 1
        if len(message.data) >= message.length:
            return bytes(message.data[: message.length])
        self._open[identifier] = message
        return None
