"""Messages to systemd: READY, WATCHDOG, STATUS, STOPPING (sd_notify(3), in the standard library).

The watchdog is fed by the loop itself, after a frame or a declared idle moment, while the other
stages live too; never from a side thread, which would keep a hung loop alive.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping


class Notifier:
    """Writes to the socket in NOTIFY_SOCKET; does nothing where there is none."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        own = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        interval_us = int(environment.get("WATCHDOG_USEC", "0")) if own else 0
        self._every_s = interval_us * 1e-6 / 2.0
        self._fed_s = 0.0
        self._said = ""
        self._ready = False

    def ready(self) -> None:
        """The service works; sent once."""
        if not self._ready:
            self._ready = True
            self._send("READY=1")

    def stopping(self) -> None:
        """The service is being stopped."""
        self._send("STOPPING=1")

    def status(self, sentence: str) -> None:
        """What ``systemctl status`` shows."""
        if sentence != self._said:
            self._said = sentence
            self._send(f"STATUS={sentence}")

    def alive(self, now_s: float | None = None) -> None:
        """Feed the watchdog, twice as often as it asks for."""
        now = time.monotonic() if now_s is None else now_s
        if self._every_s and now - self._fed_s >= self._every_s:
            self._fed_s = now
            self._send("WATCHDOG=1")

    def more_time(self, seconds: float) -> None:
        """Request more time for starting or stopping."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()

    def _send(self, message: str) -> None:
        if self._socket is None:
            return
        # A name that starts with @ lives in Linux's abstract name space.
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            self._socket.sendto(message.encode(), address)
        except OSError:
            return  # a manager that went away is no reason to stop mapping
