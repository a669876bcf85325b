"""Settings of the links to devices: serial, UDP, TCP, CAN."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from aquaflow.config.stage import Stage

Port: TypeAlias = Annotated[int, Field(ge=1, le=65535)]


class SerialConfig(Stage):
    """A serial port, a USB adapter or a pseudo terminal; 8 data bits, no parity, 1 stop bit."""

    kind: Literal["serial"] = "serial"
    port: str = Field(description="path; /dev/serial/by-id/... stays the same when replugged")
    baud: int = Field(115_200, ge=300, le=4_000_000, description="bits/s")


class UdpConfig(Stage):
    """Datagrams. ``listen`` binds the port and answers the last sender (BlueOS: an endpoint of
    type UDP client); ``send`` talks to the address first and hears its answers."""

    kind: Literal["udp"] = "udp"
    mode: Literal["listen", "send"] = "listen"
    host: str = Field("0.0.0.0", description="address to bind (listen) or of the device (send)")
    port: Port


class TcpConfig(Stage):
    """A connection that AquaFlow opens."""

    kind: Literal["tcp"] = "tcp"
    host: str
    port: Port


class CanConfig(Stage):
    """A CAN bus behind any interface of python-can."""

    kind: Literal["can"] = "can"
    interface: str = Field("socketcan", description="as python-can names it")
    channel: str = Field(description="can0, a multicast group, a serial port, ...")
    bitrate: int | None = Field(None, ge=10_000, description="bits/s; None: as the system set it")
    options: dict[str, bool | int | float | str] = Field(
        default_factory=dict, description="what else python-can's Bus of this interface takes"
    )


ByteLinkConfig: TypeAlias = Annotated[
    SerialConfig | UdpConfig | TcpConfig, Field(discriminator="kind")
]
