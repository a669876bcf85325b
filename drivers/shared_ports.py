"""Whose a datagram is, where several devices send to one UDP port.

In this order: the device that names the sender's address; for MAVLink the one that uses the
packet's system and component; the one in whose protocol it is a good packet; the one that the same
sender was last understood by. The config refuses devices that none of these tells apart.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Mapping
from functools import partial
from typing import TypeAlias

from aquaflow.config.link import UdpConfig
from aquaflow.config.telemetry import AnyDevice, MavlinkConfig, NmeaConfig
from aquaflow.drivers.link import about
from aquaflow.drivers.protocol.mavlink_frames import MavlinkFraming
from aquaflow.drivers.protocol.packets import PacketDecoder
from aquaflow.drivers.transport import OpenLink
from aquaflow.drivers.transport.ports import SharedUdp

log = logging.getLogger(__name__)

Decoders: TypeAlias = Mapping[str, PacketDecoder]
"""By the device's name."""
Address: TypeAlias = tuple[str, int]

MOST_SENDERS = 64
"""Addresses remembered, and warned of; a talker that is started again sends from a new port."""


def shared_ports(devices: Mapping[str, AnyDevice], decoders: Decoders) -> dict[str, OpenLink]:
    """How the links of devices are opened that share a port or hear one sender only, by device."""
    ports: dict[tuple[str, int], dict[str, AnyDevice]] = defaultdict(dict)
    for name, device in devices.items():
        if isinstance(device.link, UdpConfig) and device.link.mode == "listen":
            ports[device.link.host, device.link.port][name] = device
    openers: dict[str, OpenLink] = {}
    for (host, port), sharing in ports.items():
        links = [each.link for each in sharing.values() if isinstance(each.link, UdpConfig)]
        if len(sharing) > 1 or links[0].sender is not None:
            shared = SharedUdp(host, port, PortDivision(port, sharing, decoders).divide)
            openers |= {name: partial(shared.open, name) for name in sharing}
    return openers


class PortDivision:
    """Divides the datagrams of one port."""

    def __init__(self, port: int, devices: Mapping[str, AnyDevice], decoders: Decoders) -> None:
        self._port = port
        by_sender: dict[tuple[str, int | None] | None, dict[str, AnyDevice]] = defaultdict(dict)
        for name, device in devices.items():
            assert isinstance(device.link, UdpConfig)
            by_sender[device.link.sender_address][name] = device
        self._groups = {
            sender: _ByContent(group, {name: decoders[name] for name in group})
            for sender, group in by_sender.items()
        }
        self._first = next(iter(devices))
        self._counters = decoders[self._first].counters
        self._warned: set[str] = set()

    def divide(self, data: bytes, sender: Address) -> dict[str, bytes]:
        """The parts of a datagram by device; what is nobody's is counted and named once."""
        host, port = sender[:2]  # IPv6 has more
        for key in ((host, port), (host, None), None):
            group = self._groups.get(key)
            if group is not None:
                parts = group.divide(data, (host, port))
                if parts:
                    return parts
                break
        self._counters.unheard += 1
        if host not in self._warned and len(self._warned) < MOST_SENDERS:
            self._warned.add(host)
            log.warning(
                "UDP port %d: what comes from %s is of no device that listens there; state that "
                "address as the link.sender of one",
                self._port, host, extra=about(self._first, "unheard"),
            )  # fmt: skip
        return {}


class _ByContent:
    """Devices that datagrams of the same senders are for."""

    def __init__(self, devices: Mapping[str, AnyDevice], decoders: Decoders) -> None:
        self._only = next(iter(devices)) if len(devices) == 1 else None
        autopilots = {name: d for name, d in devices.items() if isinstance(d, MavlinkConfig)}
        self._mavlink = next(iter(autopilots), None)
        """Hears also what no other MAVLink device uses, and so counts and names it."""
        self._owner = {who: name for name, d in autopilots.items() for who in d.senders}
        # Other protocols' text may be a good sentence of NMEA, but not the other way round.
        others = sorted(devices, key=lambda name: isinstance(devices[name], NmeaConfig))
        self._decoders = {name: decoders[name] for name in others if name not in autopilots}
        if self._mavlink is not None:
            framing = decoders[self._mavlink].reader.framing
            assert isinstance(framing, MavlinkFraming)
            self._framing = framing
        self._last: dict[Address, str] = {}

    def divide(self, data: bytes, sender: Address) -> dict[str, bytes]:
        if self._only is not None:
            return {self._only: data}
        parts = self._packets(data)
        if not parts:
            name = next((n for n, each in self._decoders.items() if each.recognises(data)), None)
            parts = {} if name is None else {name: data}
        if parts:
            self._remember(sender, next(iter(parts)))
            return parts
        return {self._last[sender]: data} if sender in self._last else {}

    def _packets(self, data: bytes) -> dict[str, bytes]:
        """The MAVLink packets of each device; empty if there is none in ``data``."""
        if self._mavlink is None:
            return {}
        pieces = [*self._framing.pieces(data)]
        if all(header is None for header, _ in pieces):
            return {}
        parts: dict[str, bytes] = defaultdict(bytes)
        for header, piece in pieces:
            who = None if header is None else self._owner.get((header.system, header.component))
            parts[who or self._mavlink] += piece
        return parts

    def _remember(self, sender: Address, name: str) -> None:
        if len(self._last) >= MOST_SENDERS:
            self._last.clear()
        self._last[sender] = name
