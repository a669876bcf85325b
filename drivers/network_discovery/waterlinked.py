"""Water Linked DVLs on the tether (docs.waterlinked.com, networking): mDNS, and their stream."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial

from aquaflow.drivers.network_discovery.conversation import Address, answers_to, ask_server, of_each
from aquaflow.sources.discovery import FoundDevice

PORT = 16171
"""Of its JSON stream."""
USUAL_HOSTS = ("192.168.2.95", "192.168.194.95")
"""On a BlueROV2, as Water Linked's and Blue Robotics' guides set it; and its fallback address."""
MDNS = ("224.0.0.251", 5353)
"""Group of multicast DNS (RFC 6762)."""
NAME = b"\x0fwaterlinked-dvl\x05local\x00"
"""Its host name, as DNS writes names."""
QUESTION = bytes(4) + b"\x00\x01" + bytes(6) + NAME + b"\x00\x01\x80\x01"
"""Asks for its IPv4 address; the answer may come to us alone."""
REPORTS = ("velocity", "velocity_water", "position_local")
"""Types of its messages."""


def waterlinked_dvls(
    hosts: Sequence[str], port: int = PORT, group: Address = MDNS
) -> list[FoundDevice]:
    """DVLs that are heard at ``hosts``, at their usual addresses, or where their name leads to."""
    if not hosts:
        return []
    named = of_each([group], _resolve_names)
    return of_each([*hosts, *USUAL_HOSTS, *named], partial(_find_at, port=port))


def _resolve_names(group: Address) -> list[str]:
    """Where the answers come from: their content names the fallback address, whatever it is."""
    answers = answers_to(QUESTION, group)
    return [sender for answer, sender in answers if _is_answer(answer)]


def _is_answer(packet: bytes) -> bool:
    return len(packet) > 12 and bool(packet[2] & 0x80) and NAME.lower() in packet.lower()


def _find_at(host: str, port: int) -> list[FoundDevice]:
    heard = ask_server((host, port), enough=lambda data: _kind(data) is not None)
    kind = _kind(heard)
    if kind is None:
        return []
    link = {"kind": "tcp", "host": host, "port": port}
    config = {"kind": "waterlinked_json", "link": link}
    identity, name = f"tcp:{host}:{port}", f"Water Linked DVL at {host}"
    return [FoundDevice("waterlinked_json", identity, name, f"sends {kind}", config)]


def _kind(data: bytes) -> str | None:
    """The type of the first whole message that a DVL sends."""
    for line in data.split(b"\n")[:-1]:
        try:
            kind = json.loads(line)["type"]
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
        if kind in REPORTS:
            return str(kind)
    return None
