"""UDP and TCP sockets, one UDP port for several devices, and serial ports as byte links."""

from __future__ import annotations

import logging
import select
import socket
import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from aquaflow.base.errors import load
from aquaflow.config.link import SerialConfig, TcpConfig, UdpConfig
from aquaflow.drivers.link import MAX_READ_BYTES, LinkLostError
from aquaflow.sources.newest import Newest

if TYPE_CHECKING:
    from serial import Serial

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


# --------------------------------------------------------------------------------------------------
# One UDP port that several devices send to: a socket, and a link for each of them.

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


# --------------------------------------------------------------------------------------------------
# A serial port, USB adapter or pseudo terminal as a byte link.

"""115200 baud send 11 kB in it; a port that takes longer is stuck."""


class SerialLink:
    """Reads whatever the port has; unplugging shows as an error of the system call."""

    def __init__(self, name: str, port: Serial) -> None:
        self.name = name
        self._port = port

    def read(self, timeout_s: float) -> bytes:
        try:
            if self._port.timeout != timeout_s:
                self._port.timeout = timeout_s
            waiting = min(self._port.in_waiting, MAX_READ_BYTES)
            return bytes(self._port.read(max(waiting, 1)))
        # pyserial lets TypeError out when the port is closed under a read.
        except (OSError, TypeError) as error:
            raise LinkLostError(f"the port was lost: {error}") from error

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except (OSError, TypeError) as error:
            raise LinkLostError(f"the port was lost: {error}") from error

    def close(self) -> None:
        self._port.close()


def open_serial(name: str, config: SerialConfig) -> SerialLink:
    """Open the port for this process alone, as it is set up in ``config``.

    Raises:
        LinkLostError: there is no such port, or it is in use.
        InputError: pyserial is not installed.
    """
    serial = load("serial", f"the serial port {config.port}")
    try:
        port = serial.Serial(
            config.port, config.baud, timeout=0.1, write_timeout=WRITE_TIMEOUT_S, exclusive=True
        )
    except (OSError, ValueError) as error:
        raise LinkLostError(f"cannot open {config.port}: {error}") from error
    return SerialLink(name, port)
