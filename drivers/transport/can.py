"""A CAN bus as a byte link: its frames travel as the kernel's ``struct can_frame``.

So the recorder's raw bytes, the counters and the fault injector are the same as for every link.
"""

from __future__ import annotations

import struct
import time
from typing import TYPE_CHECKING, Any

from aquaflow.base.errors import load
from aquaflow.config.link import CanConfig
from aquaflow.drivers.link import MAX_READ_BYTES, LinkLostError

if TYPE_CHECKING:
    from can import BusABC, Message

RECORD = struct.Struct("<IB3x8s")
"""Identifier with flags, number of data bytes, data padded with zeros: 16 bytes."""
EXTENDED = 0x8000_0000
"""Flag of a 29 bit identifier."""
MAX_FRAMES = MAX_READ_BYTES // RECORD.size
"""Frames of one read."""


class CanLink:
    """Data frames of up to 8 bytes; error and remote frames carry no telemetry and are left out."""

    def __init__(self, name: str, bus: BusABC) -> None:
        self.name = name
        self._bus = bus
        self._closed = False
        self._error = load("can", f"the CAN bus of {name}").CanError

    def read(self, timeout_s: float) -> bytes:
        if self._closed:
            raise LinkLostError("the bus is closed")
        deadline = time.monotonic() + timeout_s
        records: list[bytes] = []
        try:
            while len(records) < MAX_FRAMES:
                # After the first record, only records that have already arrived are added.
                wait_s = 0.0 if records else max(deadline - time.monotonic(), 0.0)
                message = self._bus.recv(wait_s)
                if message is not None:
                    records += pack(message)
                elif records or time.monotonic() >= deadline:
                    break
        except (self._error, OSError, ValueError) as error:
            raise LinkLostError(f"the bus was lost: {error}") from error
        return b"".join(records)

    def write(self, data: bytes) -> None:
        """Send whole records of ``data`` as frames."""
        can = load("can", f"the CAN bus of {self.name}")
        try:
            for identifier, length, payload in RECORD.iter_unpack(data):
                extended = bool(identifier & EXTENDED)
                self._bus.send(
                    can.Message(
                        arbitration_id=identifier & ~EXTENDED,
                        is_extended_id=extended,
                        data=payload[:length],
                    )
                )
        except (self._error, OSError, ValueError) as error:
            raise LinkLostError(f"the bus was lost: {error}") from error

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._bus.shutdown()


def pack(message: Message) -> list[bytes]:
    """The record of a data frame; none of an error, remote or CAN FD frame."""
    if message.is_error_frame or message.is_remote_frame or message.is_fd:
        return []
    identifier = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
    return [RECORD.pack(identifier, len(message.data), bytes(message.data))]


def open_can(name: str, config: CanConfig) -> CanLink:
    """Join the bus.

    Raises:
        LinkLostError: the interface is not there or cannot be used.
        InputError: python-can is not installed.
    """
    can = load("can", f"the CAN bus {config.channel}")
    options: dict[str, Any] = {**config.options}
    if config.bitrate is not None:
        options["bitrate"] = config.bitrate
    try:
        bus = can.Bus(interface=config.interface, channel=config.channel, **options)
    except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
        bus_name = f"{config.interface} {config.channel}"
        raise LinkLostError(f"cannot join the CAN bus {bus_name}: {error}") from error
    return CanLink(name, bus)
