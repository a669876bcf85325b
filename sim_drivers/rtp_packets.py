"""H.264 in RTP, as cameras send it: RFC 3550 and RFC 6184."""

from __future__ import annotations

import struct
from collections.abc import Sequence

H264 = 96
"""Payload type that cameras, and BlueOS, give to H.264."""
CLOCK_HZ = 90_000
"""Of the time stamps of video (RFC 3551)."""
LARGEST = 1400
"""Bytes of payload that fit into an Ethernet frame with all headers."""
FRAGMENT, AGGREGATE = 28, 24
"""Unit types FU-A, a part of a unit, and STAP-A, several units (RFC 6184, 5.2)."""
KEPT_BITS, TYPE_BITS = 0xE0, 0x1F
"""Of a unit's first byte: what a fragment keeps of it, and its type."""


class Packetizer:
    """Makes the packets of one stream; counts them."""

    def __init__(self, payload_type: int = H264, source: int = 1) -> None:
        self.payload_type, self._source = payload_type, source
        self._number = 0

    def packets(self, units: Sequence[bytes], t_ns: int) -> list[bytes]:
        """Of one picture that was taken at ``t_ns``; the last is marked."""
        aggregated = [_aggregated(units[:-1])] if len(units) > 1 else []
        payloads = [*aggregated, *_fragments(units[-1])]
        ticks = t_ns * CLOCK_HZ // 1_000_000_000 & 0xFFFFFFFF
        return [
            self._headed(payload, ticks, position == len(payloads) - 1)
            for position, payload in enumerate(payloads)
        ]

    def _headed(self, payload: bytes, ticks: int, last: bool) -> bytes:
        kind = last << 7 | self.payload_type
        head = struct.pack(">BBHII", 0x80, kind, self._number & 0xFFFF, ticks, self._source)
        self._number += 1
        return head + payload


def session(port: int, payload_type: int = H264) -> str:
    """The description (SDP) of such a stream; port 0 where RTSP agrees on another."""
    lines = [
        *("v=0", "o=- 0 0 IN IP4 127.0.0.1", "s=camera", "c=IN IP4 0.0.0.0", "t=0 0"),
        f"m=video {port} RTP/AVP {payload_type}",
        f"a=rtpmap:{payload_type} H264/{CLOCK_HZ}",
        f"a=fmtp:{payload_type} packetization-mode=1",
        "a=control:track",
    ]
    return "".join(f"{line}\r\n" for line in lines)


def _aggregated(units: Sequence[bytes]) -> bytes:
    sized = [struct.pack(">H", len(unit)) + unit for unit in units]
    return bytes([units[0][0] & KEPT_BITS | AGGREGATE]) + b"".join(sized)


def _fragments(unit: bytes) -> list[bytes]:
    """The unit, or its parts if it is too large for one packet."""
    if len(unit) <= LARGEST:
        return [unit]
    size = LARGEST - 2
    parts = [unit[at : at + size] for at in range(1, len(unit), size)]
    return [
        bytes(
            [
                unit[0] & KEPT_BITS | FRAGMENT,
                (place == 0) << 7 | (place == len(parts) - 1) << 6 | unit[0] & TYPE_BITS,
            ]
        )
        + part
        for place, part in enumerate(parts)
    ]
