"""Serial ports, sockets, buses, mavlink2rest behind :class:`aquaflow.drivers.link.ByteLink`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from aquaflow.base.errors import load
from aquaflow.config.link import (
    CanConfig,
    Mavlink2restConfig,
    SerialConfig,
    TcpConfig,
    UdpConfig,
)
from aquaflow.drivers.link import ByteLink
from aquaflow.drivers.transport.can import open_can
from aquaflow.drivers.transport.mavlink2rest import Wants, open_mavlink2rest
from aquaflow.drivers.transport.ports import open_serial, open_tcp, open_udp

OpenLink: TypeAlias = Callable[[], ByteLink]
"""Opens a link anew; raises LinkLostError where the device or its peer is not there."""

AnyLinkConfig: TypeAlias = SerialConfig | UdpConfig | TcpConfig | CanConfig | Mavlink2restConfig


def opener(name: str, config: AnyLinkConfig, decoder: object = None) -> OpenLink:
    """How the link of device ``name`` is opened; nothing is opened yet. ``decoder`` is what will
    read it: mavlink2rest is asked for certain messages.

    Raises:
        InputError: the library that the link needs is not installed.
    """
    if isinstance(config, SerialConfig):
        load("serial", f"the serial port {config.port}")
        return lambda: open_serial(name, config)
    if isinstance(config, CanConfig):
        load("can", f"the CAN bus {config.channel}")
        return lambda: open_can(name, config)
    if isinstance(config, Mavlink2restConfig):
        assert isinstance(decoder, Wants)
        wanted = decoder.wanted
        if config.url.startswith("ws:"):
            load("websockets", f"the link to {config.url}")
        return lambda: open_mavlink2rest(name, config, wanted)
    if isinstance(config, UdpConfig):
        return lambda: open_udp(name, config)
    return lambda: open_tcp(name, config)
