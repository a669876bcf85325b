"""UDP and TCP sockets as byte links."""

from __future__ import annotations

import select
import socket
from typing import Any

from aquaflow.config.link import TcpConfig, UdpConfig
from aquaflow.drivers.link import MAX_READ_BYTES, LinkLostError

CONNECT_TIMEOUT_S = 3.0
"""A device on the vehicle's own network answers in milliseconds, or is not there."""
WRITE_TIMEOUT_S = 1.0
"""A write waits only while the peer reads nothing; what is sent is worth no longer wait."""


class UdpLink:
    """Datagrams of one peer: the configured one, or the last sender."""

    def __init__(self, name: str, sock: socket.socket, peer: Any = None) -> None:
        self.name = name
        self._socket = sock
        self._peer = peer
        self._listens = peer is None

    def read(self, timeout_s: float) -> bytes:
        try:
            if not select.select([self._socket], [], [], timeout_s)[0]:
                return b""
            data, sender = self._socket.recvfrom(MAX_READ_BYTES)
        except ConnectionError:
            return b""  # the peer is not up yet; datagrams are sent again
        except (OSError, ValueError) as error:
            raise LinkLostError(f"the socket was lost: {error}") from error
        if self._listens:
            self._peer = sender
        return data

    def write(self, data: bytes) -> None:
        if self._peer is None:
            return  # no peer to answer yet
        try:
            self._socket.sendto(data, self._peer)
        except ConnectionError:
            return
        except OSError as error:
            raise LinkLostError(f"the socket was lost: {error}") from error

    def close(self) -> None:
        self._socket.close()


class TcpLink:
    """A connection to a device that serves."""

    def __init__(self, name: str, sock: socket.socket) -> None:
        self.name = name
        self._socket = sock

    def read(self, timeout_s: float) -> bytes:
        try:
            if not select.select([self._socket], [], [], timeout_s)[0]:
                return b""
            data = self._socket.recv(MAX_READ_BYTES)
        except (OSError, ValueError) as error:
            raise LinkLostError(f"the socket was lost: {error}") from error
        if not data:
            raise LinkLostError("the device closed the connection")
        return data

    def write(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise LinkLostError(f"the socket was lost: {error}") from error

    def close(self) -> None:
        self._socket.close()


def open_udp(name: str, config: UdpConfig) -> UdpLink:
    """Bind the port, or get ready to send to it.

    Raises:
        LinkLostError: the address cannot be used.
    """
    family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_DGRAM)
    try:
        if config.mode == "send":
            peer = socket.getaddrinfo(config.host, config.port, family, socket.SOCK_DGRAM)[0][4]
            return UdpLink(name, sock, peer)
        sock.bind((config.host, config.port))
    except OSError as error:
        sock.close()
        address = f"{config.host}:{config.port}"
        raise LinkLostError(f"cannot use UDP {address}: {error}") from error
    return UdpLink(name, sock)


def open_tcp(name: str, config: TcpConfig) -> TcpLink:
    """Connect.

    Raises:
        LinkLostError: no peer answers there.
    """
    try:
        sock = socket.create_connection((config.host, config.port), CONNECT_TIMEOUT_S)
    except OSError as error:
        address = f"{config.host}:{config.port}"
        raise LinkLostError(f"cannot connect to {address}: {error}") from error
    sock.settimeout(WRITE_TIMEOUT_S)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return TcpLink(name, sock)
