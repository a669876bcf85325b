"""Network cameras made of a recording that send H.264 in RTP: bare over UDP, or by RTSP.

The time stamps in the packets are those of the exposure, however late the packets are sent.
"""

from __future__ import annotations

import select
import socket
import struct
import threading
from abc import ABC, abstractmethod

from typing_extensions import Self

from aquaflow.sim_drivers.camera_feed import CameraFeed, Shot
from aquaflow.sim_drivers.h264_writer import units
from aquaflow.sim_drivers.rtp_packets import H264, Packetizer, session

WAIT_S = 0.05
"""Longest wait for a picture before the camera looks whether it shall end."""


class _Camera(ABC):
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


class RtpCamera(_Camera):
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


class RtspCamera(_Camera):
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
