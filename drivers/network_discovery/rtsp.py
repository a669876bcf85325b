"""RTSP servers of which only the address is known."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from aquaflow.drivers.network_discovery.blueos import PORT, netloc, rtsp_ports
from aquaflow.drivers.network_discovery.conversation import Address, ask_server, of_each
from aquaflow.sources.discovery import FoundDevice

PORTS = (8554, 554)
"""Of BlueOS's camera manager and many others, and RTSP's own (RFC 2326)."""


def rtsp_streams(
    hosts: Sequence[str], ports: Sequence[int] = PORTS, manager_port: int = PORT
) -> list[FoundDevice]:
    """Servers at ``ports``, but for those whose streams BlueOS's camera manager names."""
    return of_each(hosts, partial(_of_host, ports=ports, manager_port=manager_port))


def _of_host(host: str, ports: Sequence[int], manager_port: int) -> list[FoundDevice]:
    named = rtsp_ports(host, manager_port)
    return of_each([(host, port) for port in ports if port not in named], _server)


def _server(address: Address) -> list[FoundDevice]:
    """An RTSP server, asked what it can do (OPTIONS)."""
    url = f"rtsp://{netloc(*address)}/"
    request = f"OPTIONS {url} RTSP/1.0\r\nCSeq: 1\r\n\r\n".encode()
    answer = ask_server(address, request, lambda heard: b"\r\n" in heard)
    if not answer.startswith(b"RTSP/1."):
        return []
    detail = "an RTSP server: put the path of its stream behind the address, as its page says"
    config = {"kind": "stream", "url": url}
    return [FoundDevice("stream", url, f"RTSP at {address[0]}", detail, config)]
