"""Settings of the links to devices: serial, UDP, TCP, CAN, mavlink2rest."""

from __future__ import annotations

from ipaddress import ip_address
from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from aquaflow.config.stage import StageConfig

Port: TypeAlias = Annotated[int, Field(ge=1, le=65535)]


class SerialConfig(StageConfig):
    """A serial port, a USB adapter or a pseudo terminal; 8 data bits, no parity, 1 stop bit."""

    kind: Literal["serial"] = "serial"
    port: str = Field(description="path; /dev/serial/by-id/... stays the same when replugged")
    baud: int = Field(115_200, ge=300, le=4_000_000, description="bits/s")


EVERY_ADDRESS = frozenset({"", "0.0.0.0", "::"})
"""Hosts that bind a port on all addresses of this computer."""


class UdpConfig(StageConfig):
    """Datagrams. ``listen`` binds the port and answers the last sender (BlueOS: an endpoint of
    type UDP client); ``send`` talks to the address first and hears its answers. Several devices may
    listen on one port."""

    kind: Literal["udp"] = "udp"
    mode: Literal["listen", "send"] = "listen"
    host: str = Field("0.0.0.0", description="address to bind (listen) or of the device (send)")
    port: Port
    sender: str | None = Field(
        None,
        description="of listen: whose datagrams are this device's, 192.168.2.95 or "
        "192.168.2.95:2000; None: those of everybody whom no other device on this port names",
    )

    @model_validator(mode="after")
    def _names_a_sender_by_its_address(self) -> UdpConfig:
        if self.sender is not None and self.mode == "send":
            raise ValueError("sender belongs to mode listen; with send, host is the device")
        address = self.sender_address
        if address is not None:
            ip_address(address[0])
        return self

    @property
    def sender_address(self) -> tuple[str, int | None] | None:
        """Address and port of ``sender``; ValueError where its port is no number."""
        if self.sender is None:
            return None
        if self.sender.count(":") != 1 and "]:" not in self.sender:
            return self.sender.strip("[]"), None
        host, _, port = self.sender.rpartition(":")
        return host.strip("[]"), int(port)


class TcpConfig(StageConfig):
    """A connection that AquaFlow opens."""

    kind: Literal["tcp"] = "tcp"
    host: str
    port: Port


class CanConfig(StageConfig):
    """A CAN bus behind any interface of python-can."""

    kind: Literal["can"] = "can"
    interface: str = Field("socketcan", description="as python-can names it")
    channel: str = Field(description="can0, a multicast group, a serial port, ...")
    bitrate: int | None = Field(None, ge=10_000, description="bits/s; None: as the system set it")
    options: dict[str, bool | int | float | str] = Field(
        default_factory=dict, description="what else python-can's Bus of this interface takes"
    )


class Mavlink2restConfig(StageConfig):
    """MAVLink by way of mavlink2rest, a service of BlueOS, where AquaFlow has no endpoint of its
    own."""

    kind: Literal["mavlink2rest"] = "mavlink2rest"
    url: str = Field(
        pattern=r"^(ws|http)://[^/?#]+(/[^?#]*)?$",
        description="of the service: ws://192.168.2.2:6040 to hear every message as it comes, "
        "http://192.168.2.2:6040 to ask for them",
    )
    poll_hz: float = Field(
        10.0, gt=0, le=50, description="1/s, of http: how often each message is asked for"
    )


ByteLinkConfig: TypeAlias = Annotated[
    SerialConfig | UdpConfig | TcpConfig, Field(discriminator="kind")
]

MavlinkLinkConfig: TypeAlias = Annotated[
    SerialConfig | UdpConfig | TcpConfig | Mavlink2restConfig, Field(discriminator="kind")
]
