"""One UDP port that several devices send to: a socket, and a link for each of them."""

from __future__ import annotations

import logging
import select
import socket
import threading
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from aquaflow.drivers.link import MAX_READ_BYTES, LinkLostError
from aquaflow.drivers.transport.socket import bound, send_datagram
from aquaflow.sources.newest import Newest

log = logging.getLogger(__name__)

Divide: TypeAlias = Callable[[bytes, Any], Mapping[str, bytes]]
"""From a datagram and its sender's address to the part of each device, by the device's name."""

MOST_WAITING = 1000
"""Datagrams that wait for a device's thread; then the oldest go, as in the kernel's own buffer."""
POLL_S = 0.1
"""How soon the receiving thread sees that the last link was closed."""


class SharedUdp:
    """Bound while one of its links is open; receives in a thread of its own."""

    def __init__(self, host: str, port: int, divide: Divide) -> None:
        """``divide`` is called by the receiving thread only."""
        self._host, self._port, self._divide = host, port, divide
        self._changing = threading.Lock()
        self._links: dict[str, SharedUdpLink] = {}
        self._socket: socket.socket | None = None
        self._receiver: threading.Thread | None = None
        self._stopping = threading.Event()

    def open(self, name: str) -> SharedUdpLink:
        """The link of device ``name``; raises LinkLostError where the port cannot be bound."""
        with self._changing:
            if self._receiver is None or not self._receiver.is_alive():
                self._stop()
                self._start()
            assert self._socket is not None
            link = SharedUdpLink(name, self, self._socket)
            self._links = {**self._links, name: link}
            return link

    def leave(self, link: SharedUdpLink) -> None:
        """``link`` is closed; with the last one the port is free again."""
        with self._changing:
            self._links = {n: each for n, each in self._links.items() if each is not link}
            if not self._links:
                self._stop()

    def _start(self) -> None:
        self._socket = bound(self._host, self._port)
        self._stopping.clear()
        self._receiver = threading.Thread(
            target=self._run, args=(self._socket,), name=f"UDP port {self._port}", daemon=True
        )
        self._receiver.start()

    def _stop(self) -> None:
        """A socket in use by ``select`` stays bound, so its thread ends first."""
        self._stopping.set()
        if self._receiver is not None:
            self._receiver.join()
        if self._socket is not None:
            self._socket.close()
        self._receiver = self._socket = None

    def _run(self, sock: socket.socket) -> None:
        try:
            while not self._stopping.is_set():
                if select.select([sock], [], [], POLL_S)[0]:
                    self._receive(sock)
            reason = "the port was closed"
        except OSError as error:
            reason = f"the socket was lost: {error}"
        # The thread has no caller to raise to; the links tell, and are opened anew.
        except Exception as error:
            log.exception("UDP port %d", self._port)
            reason = f"the driver failed: {error}"
        for link in self._links.values():
            link.lose(reason)

    def _receive(self, sock: socket.socket) -> None:
        try:
            data, sender = sock.recvfrom(MAX_READ_BYTES)
        except ConnectionError:
            return  # what a peer that is not up refused; datagrams are sent again
        for name, part in self._divide(data, sender).items():
            link = self._links.get(name)
            if link is not None:
                link.take(part, sender)


class SharedUdpLink:
    """A ByteLink: the datagrams of one device, answered to where the last one came from."""

    def __init__(self, name: str, port: SharedUdp, sock: socket.socket) -> None:
        self.name = name
        self._port, self._socket = port, sock
        self._waiting: Newest[bytes] = Newest(MOST_WAITING)
        self._peer: Any = None
        self._lost = "the link is closed"

    def take(self, data: bytes, sender: Any) -> None:
        """What came for this device."""
        self._peer = sender
        self._waiting.put(data)

    def lose(self, reason: str) -> None:
        """Nothing more will come."""
        self._lost = reason
        self._waiting.end()

    def read(self, timeout_s: float) -> bytes:
        data = self._waiting.take(timeout_s)
        if data is None and self._waiting.ended:
            raise LinkLostError(self._lost)
        return data or b""

    def write(self, data: bytes) -> None:
        send_datagram(self._socket, data, self._peer)

    def close(self) -> None:
        self._waiting.end(discard=True)
        self._port.leave(self)
