"""A UDP port of this computer that a camera sends to, with words for what can be wrong with it."""

from __future__ import annotations

import errno
import socket
import struct
import time
from dataclasses import dataclass
from ipaddress import ip_address

WAIT_S = 5.0
"""Longest wait for the first packet: a running camera sends some every 0.1 s."""

RTCP = range(72, 77)
"""What packets of RTCP show in the place of RTP's payload type (RFC 5761)."""

BUFFER_BYTES = 4 << 20
"""Asked of the kernel for packets that wait; it gives up to net.core.rmem_max, often 0.2 MB: 0.2 s
of 8 Mbit/s."""


@dataclass(frozen=True)
class Port:
    """Where packets arrive."""

    address: str
    """That they are sent to; only a multicast group matters here."""
    number: int

    @property
    def group(self) -> str | None:
        """The multicast group to join; None for packets sent to this computer alone."""
        try:
            return self.address if ip_address(self.address).is_multicast else None
        except ValueError:
            return None


def bound(port: Port) -> socket.socket:
    """A socket that receives what is sent to the port.

    Raises:
        ConnectionError: the port is taken.
    """
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        _bind(receiver, port, port.number, "")
        if port.group is not None:
            membership = struct.pack("4sI", socket.inet_aton(port.group), socket.INADDR_ANY)
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    except OSError:
        receiver.close()
        raise
    return receiver


def check_next_port(port: Port) -> None:
    """FFmpeg receives RTCP one port above RTP, and without it nothing, in silence.

    Raises:
        ConnectionError: that port is taken.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        why = f", which port {port.number} needs beside it for RTCP,"
        _bind(control, port, port.number + 1, why)


def first_packet(receiver: socket.socket, port: Port, wait_s: float = WAIT_S) -> bytes:
    """The first packet of media that arrives.

    Raises:
        ConnectionError: none arrives.
    """
    deadline_s = time.monotonic() + wait_s
    while (left_s := deadline_s - time.monotonic()) > 0.0:
        receiver.settimeout(left_s)
        try:
            packet = receiver.recv(1 << 16)
        except TimeoutError:
            break
        if len(packet) >= 2 and packet[1] & 0x7F not in RTCP:
            return packet
    raise ConnectionError(
        f"no packet came to UDP port {port.number} within {wait_s:g} s; the camera must send to "
        f"udp://ADDRESS-OF-THIS-COMPUTER:{port.number} (BlueOS: the stream's endpoint)"
    )


def _bind(taken: socket.socket, port: Port, number: int, why: str) -> None:
    try:
        taken.bind((port.group or "", number))
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise ConnectionError(f"UDP port {number} cannot be opened: {error}") from error
        raise ConnectionError(
            f"UDP port {number}{why} is taken by another program or camera; let the camera send "
            f"to another port"
        ) from error
