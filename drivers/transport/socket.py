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


def send_datagram(udp: socket.socket, data: bytes, peer: Any) -> None:
    """To ``peer``, an address, or nobody while there is no peer to answer (None).

    Raises:
        LinkLostError: the socket is gone; a peer that is not up yet loses the datagram.
    """
    if peer is None:
        return
    try:
        udp.sendto(data, peer)
    except ConnectionError:
        return
    except OSError as error:
        raise LinkLostError(f"the socket was lost: {error}") from error


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
        send_datagram(self._socket, data, self._peer)

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
    if config.mode == "listen":
        return UdpLink(name, bound(config.host, config.port))
    sock = _udp_socket(config.host)
    try:
        peer = socket.getaddrinfo(config.host, config.port, sock.family, socket.SOCK_DGRAM)[0][4]
    except OSError as error:
        sock.close()
        raise _unusable(config.host, config.port, error) from error
    return UdpLink(name, sock, peer)


def bound(host: str, port: int) -> socket.socket:
    """A socket that hears the port.

    Raises:
        LinkLostError: the address cannot be used.
    """
    sock = _udp_socket(host)
    try:
        sock.bind((host, port))
    except OSError as error:
        sock.close()
        raise _unusable(host, port, error) from error
    return sock


def _udp_socket(host: str) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.socket(family, socket.SOCK_DGRAM)


def _unusable(host: str, port: int, error: OSError) -> LinkLostError:
    return LinkLostError(f"cannot use UDP {host}:{port}: {error}")


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
