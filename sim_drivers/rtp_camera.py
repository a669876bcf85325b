"""Network cameras made of a recording that send H.264 in RTP: bare over UDP, or by RTSP.

The time stamps in the packets are those of the exposure, however late the packets are sent.
"""

from __future__ import annotations

import select
import socket
import struct
import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence

from typing_extensions import Self

from aquaflow.sim_drivers.camera_feed import CameraFeed, Shot
from aquaflow.sim_drivers.h264_writer import units

# --------------------------------------------------------------------------------------------------
# H.264 in RTP, as cameras send it: RFC 3550 and RFC 6184.

H264 = 96
"""Payload type that cameras, and BlueOS, give to H.264."""
CLOCK_HZ = 90_000
"""Of the time stamps of video (RFC 3551)."""
LARGEST = 1400
"""Bytes of payload that fit into an Ethernet frame with all headers."""
FRAGMENT, AGGREGATE = 28, 24
"""Unit types FU-A, a part of a unit, and STAP-A, several units (RFC 6184, 5.2)."""
KEPT_BITS, TYPE_BITS = 0xE0, 0x1F
"""Of a unit's first byte: what a fragment keeps of it, and its type."""


class Packetizer:
    """Makes the packets of one stream; counts them."""

    def __init__(self, payload_type: int = H264, source: int = 1) -> None:
        self.payload_type, self._source = payload_type, source
        self._number = 0

    def packets(self, units: Sequence[bytes], t_ns: int) -> list[bytes]:
        """The packets of one picture that was taken at ``t_ns``; the last is marked."""
        aggregated = [_aggregate(units[:-1])] if len(units) > 1 else []
        payloads = [*aggregated, *_fragments(units[-1])]
        ticks = t_ns * CLOCK_HZ // 1_000_000_000 & 0xFFFFFFFF
        return [
            self._add_header(payload, ticks, position == len(payloads) - 1)
            for position, payload in enumerate(payloads)
        ]

    def _add_header(self, payload: bytes, ticks: int, last: bool) -> bytes:
        kind = last << 7 | self.payload_type
        head = struct.pack(">BBHII", 0x80, kind, self._number & 0xFFFF, ticks, self._source)
        self._number += 1
        return head + payload


def session(port: int, payload_type: int = H264) -> str:
    """The description (SDP) of such a stream; port 0 where RTSP agrees on another."""
    lines = [
        *("v=0", "o=- 0 0 IN IP4 127.0.0.1", "s=camera", "c=IN IP4 0.0.0.0", "t=0 0"),
        f"m=video {port} RTP/AVP {payload_type}",
        f"a=rtpmap:{payload_type} H264/{CLOCK_HZ}",
        f"a=fmtp:{payload_type} packetization-mode=1",
        "a=control:track",
    ]
    return "".join(f"{line}\r\n" for line in lines)


def _aggregate(units: Sequence[bytes]) -> bytes:
    sized = [struct.pack(">H", len(unit)) + unit for unit in units]
    return bytes([units[0][0] & KEPT_BITS | AGGREGATE]) + b"".join(sized)


def _fragments(unit: bytes) -> list[bytes]:
    """The unit, or its parts if it is too large for one packet."""
    if len(unit) <= LARGEST:
        return [unit]
    size = LARGEST - 2
    parts = [unit[at : at + size] for at in range(1, len(unit), size)]
    return [
        bytes(
            [
                unit[0] & KEPT_BITS | FRAGMENT,
                (place == 0) << 7 | (place == len(parts) - 1) << 6 | unit[0] & TYPE_BITS,
            ]
        )
        + part
        for place, part in enumerate(parts)
    ]


WAIT_S = 0.05
"""Longest wait for a picture before the camera looks whether it shall end."""


class _CameraThread(ABC):
    """A thread that sends a feed's pictures, while it is plugged in."""

    def __init__(self, feed: CameraFeed, payload_type: int = H264) -> None:
        self.feed = feed
        self.sending = threading.Event()
        """While it is not set, the camera films and sends nothing."""
        self.sending.set()
        self._ending = threading.Event()
        self._packetizer = Packetizer(payload_type)
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()

    @abstractmethod
    def _run(self) -> None:
        """The thread."""

    def _next_shot(self) -> Shot | None:
        """The next picture that is sent; None if there is none yet."""
        if not self.feed.wait(WAIT_S):
            return None
        shot = self.feed.take()
        return shot if shot.unplugged or self.sending.is_set() else None

    def _packets(self, shot: Shot) -> list[bytes]:
        packets = self._packetizer.packets(units(shot.image, shot.sequence), shot.true_ns)
        return packets[: len(packets) // 2] if shot.corrupt else packets


class RtpCamera(_CameraThread):
    """Sends to a port of this computer, whether or not anyone listens; as BlueOS does to 5600."""

    def __init__(self, port: int, feed: CameraFeed, payload_type: int = H264) -> None:
        super().__init__(feed, payload_type)
        self._address = ("127.0.0.1", port)

    def _run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self._ending.is_set():
                if not self.feed.plugged_in:
                    self._ending.wait(WAIT_S)
                elif (shot := self._next_shot()) is not None and not shot.unplugged:
                    for packet in self._packets(shot):
                        sender.sendto(packet, self._address)


class RtspCamera(_CameraThread):
    """An RTSP server for one client at a time (RFC 2326), as many network cameras are. RTP goes
    over the connection itself or, if the client asks for it, over UDP."""

    def __init__(self, feed: CameraFeed) -> None:
        super().__init__(feed)
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(WAIT_S)
        self.url = f"rtsp://127.0.0.1:{self._server.getsockname()[1]}/camera"
        self.clients = 0

    def _run(self) -> None:
        with self._server:
            while not self._ending.is_set():
                try:
                    client, _ = self._server.accept()
                except TimeoutError:
                    continue
                with client:
                    if self.feed.plugged_in:
                        self._serve(client)

    def _serve(self, client: socket.socket) -> None:
        port = self._asked_to_play(client)
        if port is None:
            return
        self.clients += 1
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self._ending.is_set() and not _is_gone(client):
                shot = self._next_shot()
                if shot is None:
                    continue
                if shot.unplugged:
                    return
                try:
                    for packet in self._packets(shot):
                        if port:
                            sender.sendto(packet, ("127.0.0.1", port))
                        else:
                            client.sendall(b"$\0" + struct.pack(">H", len(packet)) + packet)
                except OSError:
                    return

    def _asked_to_play(self, client: socket.socket) -> int | None:
        """Answer requests until PLAY: the UDP port for RTP, 0 for the connection itself; None if
        the client goes before."""
        client.settimeout(5.0)
        port = 0
        with client.makefile("rb") as requests:
            while line := requests.readline():
                method = line.split()[0].decode()
                headers = {}
                while (header := requests.readline().strip()) != b"":
                    key, _, value = header.decode().partition(":")
                    headers[key.lower()] = value.strip()
                transport = headers.get("transport", "")
                if "client_port=" in transport:
                    port = int(transport.partition("client_port=")[2].split("-")[0])
                client.sendall(_answer(method, headers["cseq"], transport))
                if method == "PLAY":
                    return port
        return None


def _is_gone(client: socket.socket) -> bool:
    """What the client still says, such as reports of what it received, is not listened to."""
    try:
        has_spoken, _, _ = select.select([client], [], [], 0.0)
        return bool(has_spoken) and client.recv(1 << 16) == b""
    except OSError:
        return True


def _answer(method: str, sequence: str, transport: str) -> bytes:
    head = f"RTSP/1.0 200 OK\r\nCSeq: {sequence}\r\n"
    body = session(0) if method == "DESCRIBE" else ""
    if method == "OPTIONS":
        head += "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
    if method == "SETUP":
        chosen = transport.split(",", maxsplit=1)[0]
        server = "" if "TCP" in chosen else ";server_port=6970-6971"
        head += f"Transport: {chosen}{server}\r\n"
    if method in {"SETUP", "PLAY"}:
        head += "Session: 1\r\n"
    if method == "DESCRIBE":
        head += f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
    return f"{head}\r\n{body}".encode()
