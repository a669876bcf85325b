"""Autopilots that speak MAVLink on the network: their heartbeats, by UDP, TCP and mavlink2rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from aquaflow.drivers.link import LinkCounters
from aquaflow.drivers.mavlink_dialect import dialect as mavlink_dialect
from aquaflow.drivers.network_discovery.conversation import (
    Address,
    ask_server,
    datagrams,
    json_of,
    listener_at,
    of_each,
)
from aquaflow.drivers.protocol.mavlink_frames import MavlinkFraming, header_of
from aquaflow.drivers.protocol.packets import PacketReader
from aquaflow.sources.discovery import FoundDevice

UDP_PORTS = (14550, 14600)
"""Of ground stations, to which BlueOS sends by default, and the one of our examples."""
TCP_PORTS = (5777, 5760)
"""Of BlueOS's server and of ArduPilot's simulation."""
REST_PORT = 6040
"""Of mavlink2rest, a service of BlueOS."""
REST_PATHS = ("/v1/mavlink", "/mavlink")
"""Of its versions 1 and 0."""
HEARTBEAT = 0
"""Number of the message."""
NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID: ground stations, cameras and other components."""


class Autopilot(NamedTuple):
    """Who sent a heartbeat."""

    system: int
    component: int
    kind: str
    """ArduPilot's name of the vehicle, such as submarine."""


def mavlink_links(
    hosts: Sequence[str],
    udp_ports: Sequence[int] = UDP_PORTS,
    tcp_ports: Sequence[int] = TCP_PORTS,
    rest_port: int = REST_PORT,
) -> list[FoundDevice]:
    """Links by which an autopilot is heard.

    Raises:
        InputError: pymavlink is not installed.
    """
    if not hosts:
        return []
    dialect = mavlink_dialect("looking for MAVLink")
    places: list[tuple[str, Address]] = [("udp", ("0.0.0.0", port)) for port in udp_ports]
    places += [("tcp", (host, port)) for host in hosts for port in tcp_ports]
    places += [("rest", (host, rest_port)) for host in hosts]

    def ask(place: tuple[str, Address]) -> list[FoundDevice]:
        way, address = place
        if way == "udp":
            return _sent_here(dialect, address[1])
        return _serve(dialect, address) if way == "tcp" else _by_rest(address)

    return of_each(places, ask)


def _sent_here(dialect: Any, port: int) -> list[FoundDevice]:
    listener = listener_at(port)
    if listener is None:
        detail = "another program listens there, such as a ground station or this service: no look"
        return [FoundDevice("mavlink", f"udp:{port}", f"UDP port {port}", detail)]
    heard = AutopilotHeartbeats(dialect)
    with listener:
        senders = [sender for data, sender in datagrams(listener) if heard.feed(data)]
    link = {"kind": "udp", "port": port}
    return (
        _found_devices(heard.autopilots, f"from {senders[0]}", f"udp:{port}", link)
        if senders
        else []
    )


def _serve(dialect: Any, address: Address) -> list[FoundDevice]:
    heard = AutopilotHeartbeats(dialect)
    heard.feed(
        ask_server(address, enough=lambda data: bool(AutopilotHeartbeats(dialect).feed(data)))
    )
    host, port = address
    link = {"kind": "tcp", "host": host, "port": port}
    return _found_devices(heard.autopilots, f"at {host}", f"tcp:{host}:{port}", link)


def _by_rest(address: Address) -> list[FoundDevice]:
    host, port = address
    for path in REST_PATHS:
        answer = json_of(address, f"{path}/vehicles/1/components/1/messages/HEARTBEAT")
        try:
            kind = str(answer["message"]["mavtype"]["type"])
        except (KeyError, TypeError):
            continue
        kind = kind.removeprefix("MAV_TYPE_").replace("_", " ").lower()
        link = {"kind": "mavlink2rest", "url": f"ws://{host}:{port}"}
        return _found_devices(
            [Autopilot(1, 1, kind)], f"by mavlink2rest at {host}", link["url"], link
        )
    return []


class AutopilotHeartbeats:
    """The autopilots in a stream of bytes."""

    def __init__(self, dialect: Any) -> None:
        self._dialect = dialect
        self._reader = PacketReader(MavlinkFraming(dialect), LinkCounters())
        self.autopilots: list[Autopilot] = []

    def feed(self, data: bytes) -> bool:
        """True if ``data`` completes an autopilot's heartbeat."""
        before = len(self.autopilots)
        for packet in self._reader.feed(data):
            header = header_of(packet)
            if header.message_id == HEARTBEAT:
                message = self._dialect.MAVLink(None).decode(bytearray(packet))
                if message.autopilot != NO_AUTOPILOT:
                    kind = _kind_of(self._dialect, message.type)
                    self.autopilots.append(Autopilot(header.system, header.component, kind))
        return len(self.autopilots) > before


def _kind_of(dialect: Any, number: int) -> str:
    entry = dialect.enums["MAV_TYPE"].get(number)
    name = "vehicle" if entry is None else str(entry.name)
    return name.removeprefix("MAV_TYPE_").replace("_", " ").lower()


def _found_devices(
    autopilots: Sequence[Autopilot], place: str, identity: str, link: dict[str, Any]
) -> list[FoundDevice]:
    """One for each autopilot."""
    found = []
    for system, component, kind in dict.fromkeys(autopilots):
        config: dict[str, Any] = {"kind": "mavlink", "link": link}
        if (system, component) != (1, 1):
            config |= {"system_id": system, "component_id": component}
        detail = f"heartbeats of system {system}, component {component}"
        found.append(FoundDevice("mavlink", identity, f"{kind} {place}", detail, config))
    return found
