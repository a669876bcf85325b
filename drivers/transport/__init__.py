"""Serial ports, sockets and CAN buses behind :class:`aquaflow.drivers.link.ByteLink`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from aquaflow.config.link import CanConfig, SerialConfig, TcpConfig, UdpConfig
from aquaflow.drivers.extra import load
from aquaflow.drivers.link import ByteLink
from aquaflow.drivers.transport.can import open_can
from aquaflow.drivers.transport.serial import open_serial
from aquaflow.drivers.transport.socket import open_tcp, open_udp

OpenLink: TypeAlias = Callable[[], ByteLink]
"""Opens a link anew; raises LinkLostError where the device or its peer is not there."""

AnyLinkConfig: TypeAlias = SerialConfig | UdpConfig | TcpConfig | CanConfig


def opener(name: str, config: AnyLinkConfig) -> OpenLink:
    """How the link of device ``name`` is opened; nothing is opened yet.

    Raises:
        InputError: the library that the link needs is not installed.
    """
    if isinstance(config, SerialConfig):
        load("serial", f"the serial port {config.port}")
        return lambda: open_serial(name, config)
    if isinstance(config, CanConfig):
        load("can", f"the CAN bus {config.channel}")
        return lambda: open_can(name, config)
    if isinstance(config, UdpConfig):
        return lambda: open_udp(name, config)
    return lambda: open_tcp(name, config)
