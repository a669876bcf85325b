"""The device's end of real links: pseudo terminals, UDP, TCP, CAN."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import tty
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aquaflow.config.link import CanConfig

if TYPE_CHECKING:
    import can

PATIENCE_S = 1.0
"""A reader that takes nothing for so long is not there; a serial line does not wait for it."""
READ_BYTES = 4096
"""Most that one read takes; the rest comes with the next one."""


class PtyWire:
    """A pseudo terminal; ``path`` leads to it whenever it is plugged in, as by-id paths do."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fds: tuple[int, int] | None = None
        self.plug()

    def plug(self) -> None:
        """Create the port, as a new device."""
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        fresh = self.path.with_name(self.path.name + ".new")
        fresh.symlink_to(os.ttyname(slave))
        fresh.replace(self.path)
        # Our own end of the slave keeps the line up while no other process has it open.
        self._fds = (master, slave)

    def unplug(self) -> None:
        """Remove the port; a process that has it open gets an error."""
        if self._fds is not None:
            fds, self._fds = self._fds, None
            self.path.unlink(missing_ok=True)
            for fd in fds:
                os.close(fd)

    def send(self, packet: bytes) -> None:
        left = packet
        while left and self._fds is not None:
            try:
                left = left[os.write(self._fds[0], left) :]
            except BlockingIOError:
                if not select.select([], [self._fds[0]], [], PATIENCE_S)[1]:
                    break
            except OSError:
                break

    def receive(self) -> bytes | None:
        if self._fds is None:
            return None
        try:
            return os.read(self._fds[0], READ_BYTES) or None
        except OSError:
            return None

    def close(self) -> None:
        self.unplug()


class UdpWire:
    """Datagrams to ``peer``; without one, to the last sender to ``port``."""

    def __init__(self, peer: tuple[str, int] | None = None) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._peer = peer
        if peer is None:
            self._socket.bind(("127.0.0.1", 0))

    @property
    def port(self) -> int:
        """The port that it sends from."""
        return int(self._socket.getsockname()[1])

    def send(self, packet: bytes) -> None:
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(packet, self._peer)

    def receive(self) -> bytes | None:
        try:
            data, sender = self._socket.recvfrom(65_536)
        except OSError:
            return None
        self._peer = sender
        return data

    def close(self) -> None:
        self._socket.close()


class TcpWire:
    """A server for one client at a time."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.setblocking(False)
        self._client: socket.socket | None = None

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self._server.getsockname()[1])

    def unplug(self) -> None:
        """Close the connection; the next client is welcome."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def send(self, packet: bytes) -> None:
        client = self._accept()
        if client is not None:
            try:
                client.sendall(packet)
            except OSError:
                self.unplug()

    def receive(self) -> bytes | None:
        client = self._accept()
        if client is None:
            return None
        try:
            if not select.select([client], [], [], 0.0)[0]:
                return None
            data = client.recv(READ_BYTES)
        except (OSError, ValueError):  # ValueError: another thread has just unplugged it
            data = b""
        if not data:
            self.unplug()
        return data or None

    def close(self) -> None:
        self.unplug()
        self._server.close()

    def _accept(self) -> socket.socket | None:
        if self._client is None:
            with contextlib.suppress(OSError):
                client, _ = self._server.accept()
                client.settimeout(PATIENCE_S)
                self._client = client
        return self._client


class CanWire:
    """A node on any bus of python-can."""

    def __init__(self, config: CanConfig) -> None:
        import can

        options: dict[str, Any] = {**config.options}
        self._bus: can.BusABC | None = can.Bus(
            interface=config.interface, channel=config.channel, **options
        )

    def send(self, packet: can.Message) -> None:
        if self._bus is not None:
            with contextlib.suppress(OSError, ValueError):
                self._bus.send(packet)

    def receive(self) -> can.Message | None:
        return self._bus.recv(0.0) if self._bus is not None else None

    def close(self) -> None:
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None
