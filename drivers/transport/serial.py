"""A serial port, USB adapter or pseudo terminal as a byte link."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aquaflow.base.errors.extra import load
from aquaflow.config.link import SerialConfig
from aquaflow.drivers.link import MAX_READ_BYTES, LinkLostError

if TYPE_CHECKING:
    from serial import Serial

WRITE_TIMEOUT_S = 1.0
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
