"""Video that is sent to this computer: RTP, as BlueOS does to port 5600, or MPEG-TS."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from aquaflow.drivers.network_discovery.conversation import datagrams, listener_at, of_each
from aquaflow.sources.discovery import FoundDevice

PORTS = (5600, 5601, 5602)
"""Of BlueOS's first three cameras, and of QGroundControl."""
ENOUGH = 40
"""Packets: several pictures."""
MPEG_TS = 0x47
"""First byte of a packet of MPEG-TS."""
H264_TYPES = frozenset({1, 5, 7, 8, 24, 28})
"""Slices, parameter sets, aggregates and fragments (RFC 6184)."""
H265_TYPES = frozenset({1, 19, 20, 21, 32, 33, 34, 48, 49})
"""The same in H.265 (RFC 7798)."""


def rtp_streams(hosts: Sequence[str], ports: Sequence[int] = PORTS) -> list[FoundDevice]:
    """What arrives at ``ports``, from whomever: ``hosts`` are not asked."""
    return of_each(ports, _at) if hosts else []


def _at(port: int) -> list[FoundDevice]:
    url = f"udp://0.0.0.0:{port}"
    listener = listener_at(port)
    if listener is None:
        detail = "another program listens there, such as a ground station or this service: no look"
        return [FoundDevice("stream", url, f"UDP port {port}", detail)]
    packets, senders = [], []
    with listener:
        for packet, sender in datagrams(listener):
            packets.append(packet)
            senders.append(sender)
            if len(packets) == ENOUGH:
                break
    codec = _codec(packets)
    if codec is None:
        return []
    config: dict[str, Any] = {"kind": "stream", "url": url}
    if codec == "H.265":
        config["codec"] = "h265"
    return [FoundDevice("stream", url, f"video from {senders[0]}", codec, config)]


def _codec(packets: Sequence[bytes]) -> str | None:
    """What most packets hold; None if that is no video."""
    kinds = [kind for packet in packets if (kind := _kind(packet)) is not None]
    most = max(kinds, key=kinds.count, default=None)
    return most if 2 * len(kinds) > len(packets) else None


def _kind(packet: bytes) -> str | None:
    if packet[:1] == bytes([MPEG_TS]):
        return "MPEG-TS"
    payload = rtp_payload(packet)
    if len(payload) < 2 or payload[0] & 0x80:
        return None
    # The second byte of H.265 holds the layer, 0, and the temporal layer, of which there is one.
    if payload[1] == 1 and payload[0] >> 1 in H265_TYPES:
        return "H.265"
    return "H.264" if payload[0] & 0x1F in H264_TYPES else None


def rtp_payload(packet: bytes) -> bytes:
    """What an RTP packet of video carries (RFC 3550); empty if it is none."""
    if len(packet) < 12 or packet[0] >> 6 != 2 or packet[1] & 0x7F < 96:
        return b""
    start = 12 + 4 * (packet[0] & 0x0F)
    if packet[0] & 0x10 and len(packet) >= start + 4:
        start += 4 + 4 * int.from_bytes(packet[start + 2 : start + 4], "big")
    return packet[start:]
