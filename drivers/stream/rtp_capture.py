"""H.264 in RTP at a UDP port, such as a BlueROV2's on 5600, read packet by packet."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.capture import RawPicture
from aquaflow.drivers.ffmpeg import rgb_of
from aquaflow.drivers.h264 import (
    KEY_PICTURE,
    PICTURE_PARAMETERS,
    SEQUENCE_PARAMETERS,
    TYPE_BITS,
    Units,
    decode,
)
from aquaflow.drivers.stream.capture import OPEN_TIMEOUT_S, Ages
from aquaflow.drivers.stream.session import Session
from aquaflow.types import CameraModel

NEEDED = frozenset({KEY_PICTURE, SEQUENCE_PARAMETERS, PICTURE_PARAMETERS})
"""Types of the units with which decoding begins."""
LOST = "lost packets on its way"


class RtpCapture:
    """One connection: it lasts while packets come."""

    camera: CameraModel | None = None
    notes: tuple[str, ...] = ()

    def __init__(
        self,
        name: str,
        config: StreamConfig,
        session: Session,
        receiver: socket.socket,
        first: bytes,
    ) -> None:
        """Go on with a socket that the ``first`` packet came from; it is closed with this."""
        self._config, self._session, self._receiver = config, session, receiver
        self.format = f"H264 in RTP on UDP port {session.port.number}"
        self._depacketizer = Depacketizer(session.payload_type(first))
        self._ages = Ages(name, config)
        self._pictures = decode(self._receive_pictures(first))

    def read(self, timeout_s: float) -> RawPicture | None:
        """The next picture; waits up to the configured stall time for its packets.

        Raises:
            TimeoutError: no packets come.
            ConnectionError: packets come, but no picture.
        """
        picture, bgr = next(self._pictures)
        exposed_ns, stale = self._ages.judge(picture.stream_ns, picture.arrival_ns)
        shown = rgb_of(bgr) if picture.is_whole else rgb_of(None, LOST)
        return RawPicture(time.monotonic_ns(), shown, exposed_ns=exposed_ns, stale=stale)

    def close(self) -> None:
        self._pictures.close()
        self._receiver.close()

    def _receive_pictures(self, first: bytes) -> Iterator[tuple[ReceivedPicture, Units]]:
        """Pictures from the first on that can be decoded."""
        deadline_s, packet, has_begun = time.monotonic() + OPEN_TIMEOUT_S, first, False
        while True:
            for picture in self._depacketizer.add(packet, time.monotonic_ns()):
                units = picture.units
                if not has_begun:
                    units = [*self._session.parameters, *units]
                    has_begun = {each[0] & TYPE_BITS for each in units if each} >= NEEDED
                if has_begun:
                    yield picture, units
            if not has_begun and time.monotonic() > deadline_s:
                raise ConnectionError(
                    f"packets come to UDP port {self._session.port.number}, but no key picture "
                    f"within {OPEN_TIMEOUT_S:g} s; is its codec h264, and does it send key frames "
                    f"with parameters?"
                )
            packet = self._next_packet()

    def _next_packet(self) -> bytes:
        self._receiver.settimeout(self._config.stall_s)
        try:
            return self._receiver.recv(1 << 16)
        except TimeoutError as error:
            said = f"no packet came to UDP port {self._session.port.number}"
            raise TimeoutError(f"{said} for {self._config.stall_s:g} s") from error


# --------------------------------------------------------------------------------------------------
# H.264 pictures out of RTP packets (RFC 3550; RFC 6184, packetization modes 0 and 1).
#
# A picture is complete with its marked packet: nothing has to be waited for. FFmpeg waits for the
# first packet of the next picture, and fills what lost packets leave open without a word.

CLOCK_HZ = 90_000
"""Of the time stamps of video (RFC 3551)."""
HEADER_BYTES = 12
"""Of an RTP packet without extensions."""
LARGEST_WHOLE, AGGREGATE, FRAGMENT = 23, 24, 28
"""Unit types: up to the first, a unit of H.264 itself; STAP-A, several of them; FU-A, a part."""
KEPT_BITS, FIRST_BIT, LAST_BIT = 0xE0, 0x80, 0x40
"""Of the first byte of a fragmented unit; of its second."""


@dataclass
class ReceivedPicture:
    """An access unit."""

    stream_ns: int
    """When it was taken, on the sender's clock."""
    arrival_ns: int
    """When its first packet came."""
    units: Units = field(default_factory=list)
    is_whole: bool = True
    """False where packets of it, or right before it, were lost."""


class Depacketizer:
    """The packets of one sender, in the order in which they come."""

    def __init__(self, payload_type: int) -> None:
        """Packets of other payload types are not looked at."""
        self._payload_type = payload_type
        self._number: int | None = None
        """Of the packet that is expected."""
        self._ticks: int | None = None
        self._time = 0
        self._picture: ReceivedPicture | None = None
        self._fragments = bytearray()
        self._gap = False
        """Packets were lost right before the one at hand."""

    def add(self, packet: bytes, arrival_ns: int) -> list[ReceivedPicture]:
        """The pictures that this packet completes: one with its last packet, or one whose last
        packet was lost."""
        payload = self._payload(packet)
        if payload is None:
            return []
        done = []
        number, ticks = struct.unpack_from(">HI", packet, 2)
        if self._is_late(number):
            return []
        if self._picture is not None and ticks != self._ticks:
            self._picture.is_whole = False
            done.append(self._finish())
        self._begin(ticks, arrival_ns)
        self._unpack(payload)
        if packet[1] & 0x80:
            done.append(self._finish())
        return [picture for picture in done if picture.units]

    def _payload(self, packet: bytes) -> bytes | None:
        """Without header and padding; None where it is none of this stream's."""
        if len(packet) <= HEADER_BYTES or packet[1] & 0x7F != self._payload_type:
            return None
        start = HEADER_BYTES + 4 * (packet[0] & 0x0F)
        if packet[0] & 0x10 and len(packet) >= start + 4:
            start += 4 + 4 * struct.unpack_from(">H", packet, start + 2)[0]
        end = len(packet) - (packet[-1] if packet[0] & 0x20 else 0)
        return packet[start:end] if start < end else None

    def _is_late(self, number: int) -> bool:
        """Notes what is missing; True for a packet that was missed already, or came twice."""
        ahead = 0 if self._number is None else (number - self._number) & 0xFFFF
        if ahead >= 0x8000:
            return True
        self._number = number + 1 & 0xFFFF
        if ahead > 0:
            self._gap = True
            self._fragments.clear()
            if self._picture is not None:
                self._picture.is_whole = False
        return False

    def _begin(self, ticks: int, arrival_ns: int) -> None:
        if self._picture is None:
            step = 0 if self._ticks is None else (ticks - self._ticks + 2**31) % 2**32 - 2**31
            self._ticks, self._time = ticks, self._time + step
            stream_ns = self._time * 1_000_000_000 // CLOCK_HZ
            self._picture = ReceivedPicture(stream_ns, arrival_ns, is_whole=not self._gap)
        self._gap = False

    def _finish(self) -> ReceivedPicture:
        assert self._picture is not None
        picture, self._picture = self._picture, None
        picture.is_whole &= not self._fragments
        self._fragments.clear()
        return picture

    def _unpack(self, payload: bytes) -> None:
        assert self._picture is not None
        kind = payload[0] & TYPE_BITS
        if 0 < kind <= LARGEST_WHOLE:
            self._picture.units.append(payload)
        elif kind == AGGREGATE:
            self._picture.units += _aggregate(payload)
        elif kind == FRAGMENT and len(payload) > 2:
            self._join(payload)
        else:
            self._picture.is_whole = False

    def _join(self, payload: bytes) -> None:
        """A part of a unit; of one whose beginning was lost, nothing is used."""
        assert self._picture is not None
        if payload[1] & FIRST_BIT:
            self._fragments[:] = bytes([payload[0] & KEPT_BITS | payload[1] & TYPE_BITS])
        elif not self._fragments:
            self._picture.is_whole = False
            return
        self._fragments += payload[2:]
        if payload[1] & LAST_BIT:
            self._picture.units.append(bytes(self._fragments))
            self._fragments.clear()


def _aggregate(payload: bytes) -> Units:
    units, at = [], 1
    while at + 2 < len(payload):
        (size,) = struct.unpack_from(">H", payload, at)
        units.append(payload[at + 2 : at + 2 + size])
        at += 2 + size
    return units
