"""A Ping echo sounder of Blue Robotics by its own protocol (docs.bluerobotics.com/ping-protocol).

It speaks when it is asked: by a general request for each measurement, or by one command for a
stream of profiles. Messages hold no time, so ``t_ns`` is the arrival.
"""

from __future__ import annotations

import logging
import struct

from aquaflow.config.instruments import PingConfig
from aquaflow.drivers.link import about
from aquaflow.drivers.protocol.packets import INCOMPLETE, NO_PACKET, Framing, PacketDecoder
from aquaflow.types import Altitude, TelemetrySample

log = logging.getLogger(__name__)

MARK = b"BR"
"""First bytes of every message."""
HEADER = struct.Struct("<2sHHBB")
"""Mark, length of the payload, message, device that sends, device that is meant."""
CHECKSUM = 2
"""Bytes: the sum of all before, modulo 65536."""
LONGEST = HEADER.size + 4096 + CHECKSUM
"""Bytes; a profile has 200 points, of the open firmware 1200 and more."""
NACK, GENERAL_REQUEST, CONTINUOUS_START = 2, 6, 1400
"""Messages to and from every device."""
DISTANCE_SIMPLE, DISTANCE, PROFILE = 1211, 1212, 1300
"""Messages of a Ping1D that hold a distance."""
NAMES = {DISTANCE_SIMPLE: "distance_simple", DISTANCE: "distance", PROFILE: "profile"}
NUMBERS = {name: number for number, name in NAMES.items()}
SIMPLE = struct.Struct("<IB")
"""Distance in mm, confidence in percent."""
FULL = struct.Struct("<IHHI")
"""Distance in mm, confidence in percent, length of the pulse, number of the measurement."""
ANSWER_NS = 500_000_000
"""A sounder that has not answered for so long did not hear; the standard allows it 50 ms, and a
measurement over 100 m takes 133 ms."""
STREAM_NS = 3_000_000_000
"""A stream that has stopped for so long is started again: the sounder was switched off and on."""


class PingFraming(Framing):
    """Header with the payload's length, payload, a sum of all bytes."""

    longest = LONGEST

    def find(self, buffer: bytes, at: int) -> int:
        found = buffer.find(MARK, at)
        return len(buffer) - 1 if found < 0 and buffer.endswith(MARK[:1]) else found

    def length(self, buffer: bytes, at: int) -> int:
        if len(buffer) - at < HEADER.size:
            return INCOMPLETE
        payload = int(HEADER.unpack_from(buffer, at)[1])
        length = HEADER.size + payload + CHECKSUM
        return length if length <= LONGEST else NO_PACKET

    def intact(self, packet: bytes) -> bool:
        (sent,) = struct.unpack_from("<H", packet, len(packet) - CHECKSUM)
        return sum(packet[:-CHECKSUM]) & 0xFFFF == int(sent)


class PingDecoder(PacketDecoder):
    """Altitude from each measurement once, and the requests for it."""

    def __init__(self, name: str, config: PingConfig) -> None:
        super().__init__(name, PingFraming())
        self._config = config
        self._measured: int | None = None
        self._ask_at_ns = self._asked_ns = 0
        self._said_refused = False

    def decode(self, packet: bytes, arrival_ns: int) -> list[TelemetrySample]:
        number = int(HEADER.unpack_from(packet)[2])
        payload = packet[HEADER.size : -CHECKSUM]
        if number == NACK:
            self._log_refusal(payload)
            return []
        if number not in NAMES:
            return []
        self._record_answer(arrival_ns)
        if number == DISTANCE_SIMPLE:
            distance_mm, confidence = SIMPLE.unpack_from(payload)
        else:
            distance_mm, confidence, _, measured = FULL.unpack_from(payload)
            if measured == self._measured:
                return []  # asked sooner than it measures, it says the same again
            self._measured = measured
        if confidence < self._config.min_confidence or distance_mm == 0:
            raise ValueError("the sounder hardly trusts its distance")
        source = self.source(NAMES[number])
        return [Altitude(arrival_ns, arrival_ns, source, distance_mm / 1000.0)]

    def outgoing(self, now_ns: int) -> bytes:
        """The request that is due, if any."""
        asked = self._config.ask_for
        if asked is None or now_ns < self._ask_at_ns:
            return b""
        if asked == "stream":
            self._ask_at_ns = now_ns + STREAM_NS
            return message(CONTINUOUS_START, PROFILE)
        self._ask_at_ns = now_ns + max(ANSWER_NS, self._interval_ns)
        self._asked_ns = now_ns
        return message(GENERAL_REQUEST, NUMBERS[asked])

    def reset(self) -> None:
        super().reset()
        self._ask_at_ns, self._measured = 0, None

    @property
    def _interval_ns(self) -> int:
        return round(self._config.interval_s * 1e9)

    def _record_answer(self, now_ns: int) -> None:
        streams = self._config.ask_for == "stream"
        self._ask_at_ns = now_ns + STREAM_NS if streams else self._asked_ns + self._interval_ns

    def _log_refusal(self, payload: bytes) -> None:
        """NACK: the message that was refused, and why."""
        (refused,) = struct.unpack_from("<H", payload)
        self.counters.invalid_values += 1
        if not self._said_refused:
            self._said_refused = True
            words = payload[2:].rstrip(b"\0").decode("ascii", "replace")
            log.warning(
                "%s: the sounder refuses message %d: %s", self.name, refused, words,
                extra=about(self.name, "refused"),
            )  # fmt: skip


def message(number: int, about: int) -> bytes:
    """A message whose payload is the number of another one."""
    data = HEADER.pack(MARK, 2, number, 0, 0) + struct.pack("<H", about)
    return data + struct.pack("<H", sum(data) & 0xFFFF)
