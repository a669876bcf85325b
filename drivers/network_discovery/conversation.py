"""Short talks with what may be at an address; silence, refusal and nonsense are no answer."""

from __future__ import annotations

import http.client
import json
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import closing
from typing import Any, TypeVar

CONNECT_S = 1.0
"""A device on the vehicle's own network answers in milliseconds, or is not there."""
LISTEN_S = 2.5
"""Two heartbeats of a second, and some of a DVL that pings twice a second."""
ANSWER_S = 1.0
"""Devices wait up to 0.5 s before they answer a multicast (WS-Discovery; mDNS: 0.12 s)."""
MOST_BYTES = 1 << 18
"""Of one answer; a camera manager's list of streams has some thousand."""
DATAGRAM = 65_536
"""The largest."""

Address = tuple[str, int]
T = TypeVar("T")
Item = TypeVar("Item", bound=Hashable)


def of_each(items: Iterable[Item], ask: Callable[[Item], list[T]]) -> list[T]:
    """What ``ask`` finds at each of ``items``, all asked at once; in their order."""
    found: dict[Item, list[T]] = {item: [] for item in items}

    def look(item: Item) -> None:
        found[item] = ask(item)

    # Daemons: a name that resolves to nothing for a minute must not keep the program from ending.
    threads = [threading.Thread(target=look, args=(item,), daemon=True) for item in found]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [each for devices in found.values() for each in devices]


def ask_server(
    address: Address, request: bytes = b"", enough: Callable[[bytes], bool] = bool
) -> bytes:
    """What a TCP server says, to ``request`` if there is one, until it is ``enough`` or time is up;
    nothing where there is no server."""
    heard = b""
    try:
        with socket.create_connection(address, CONNECT_S) as connection:
            connection.sendall(request)
            until_s = time.monotonic() + LISTEN_S
            while not enough(heard) and len(heard) < MOST_BYTES:
                connection.settimeout(max(0.001, until_s - time.monotonic()))
                data = connection.recv(DATAGRAM)
                if not data or time.monotonic() > until_s:
                    break
                heard += data
    except (OSError, ValueError):  # ValueError: the host is no name
        pass
    return heard


def json_of(address: Address, path: str) -> Any:
    """What an HTTP server answers to GET; None if it is no JSON."""
    try:
        with closing(http.client.HTTPConnection(*address, timeout=CONNECT_S)) as connection:
            connection.request("GET", path)
            answer = connection.getresponse()
            body = answer.read(MOST_BYTES)
            return json.loads(body) if answer.status == http.client.OK else None
    except (OSError, ValueError, http.client.HTTPException, RecursionError):
        return None


def datagrams(listener: socket.socket, seconds: float | None = None) -> Iterator[tuple[bytes, str]]:
    """What arrives within ``seconds`` (LISTEN_S), each with the address of its sender."""
    until_s = time.monotonic() + (LISTEN_S if seconds is None else seconds)
    while (left_s := until_s - time.monotonic()) > 0.0:
        if select.select([listener], [], [], left_s)[0]:
            try:
                data, sender = listener.recvfrom(DATAGRAM)
            except OSError:  # ICMP: an earlier datagram of ours was refused
                continue
            yield data, str(sender[0])


def listener_at(port: int) -> socket.socket | None:
    """A socket on a UDP port of this computer; None if another program has it.

    Without SO_REUSEADDR: with it, that program would lose its datagrams to us.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listener.bind(("0.0.0.0", port))
    except OSError:
        listener.close()
        return None
    return listener


def answers_to(request: bytes, group: Address) -> list[tuple[bytes, str]]:
    """What answers to a datagram sent to a multicast group by every interface of this computer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
        for index, _ in socket.if_nameindex():
            interface = struct.pack("=4s4si", bytes(4), bytes(4), index)  # struct ip_mreqn
            try:
                asking.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, interface)
                asking.sendto(request, group)
            except OSError:  # it is down, or has no address
                continue
        return list(datagrams(asking, ANSWER_S))
