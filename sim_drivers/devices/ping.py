"""A Ping1D echo sounder, as docs.bluerobotics.com/ping-protocol describes it."""

from __future__ import annotations

import struct

from aquaflow.types import Altitude, TelemetrySample

POINTS = 200
"""Of a profile."""
RANGE_MM = 50_000
"""Length of the scan that the messages state."""


class Ping1D:
    """Answers requests with the last altitude; once told to stream, sends a profile for each."""

    def __init__(self, streams: bool = False) -> None:
        """``streams``: it was told to before."""
        self.streams = streams
        self.confidence = 97
        """Percent."""
        self.requests = 0
        """General requests heard."""
        self._altitude_m = 0.0
        self._measured = 0

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[bytes]:
        if not isinstance(sample, Altitude):
            return []
        self._altitude_m = sample.altitude_m
        self._measured += 1
        return [self._message(1300)] if self.streams else []

    def answer(self, packet: bytes, now_ns: int) -> list[bytes]:
        """Requests come one by one: the other side waits for the answer."""
        _, length, number, _, _ = struct.unpack_from("<2sHHBB", packet)
        assert length == 2
        (about,) = struct.unpack_from("<H", packet, 8)
        if number == 1400:
            self.streams = about == 1300
            return [] if self.streams else [frame(2, struct.pack("<H", number) + b"no such stream")]
        assert number == 6
        self.requests += 1
        return [self._message(about)]

    def due_packets(self, now_ns: int) -> list[bytes]:
        return []

    def _message(self, number: int) -> bytes:
        millimetres = round(1000 * self._altitude_m)
        if number == 1211:
            return frame(number, struct.pack("<IB", millimetres, self.confidence))
        told = (millimetres, self.confidence, 80, self._measured, 0, RANGE_MM, 3)
        payload = struct.pack("<IHHIIII", *told)
        if number == 1300:
            payload += struct.pack("<H", POINTS) + bytes(k % 256 for k in range(POINTS))
        return frame(number, payload)


def frame(number: int, payload: bytes) -> bytes:
    """A message from device 1 to device 0, with the sum of its bytes."""
    data = b"BR" + struct.pack("<HHBB", len(payload), number, 1, 0) + payload
    return data + struct.pack("<H", sum(data) % 65536)
