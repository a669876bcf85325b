"""Network cameras made of a recording that send MPEG-TS: bare over UDP, or by RTSP."""

from __future__ import annotations

import socket
import struct
import tempfile
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

DATAGRAM = 7 * 188
"""Bytes: as many packets of MPEG-TS as fit into one Ethernet frame."""

RTP_MPEG_TS = 33
"""RTP payload type of MPEG-TS (RFC 3551)."""

SDP = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\n"
    f"m=video 0 RTP/AVP {RTP_MPEG_TS}\r\na=control:track\r\n"
)
"""What DESCRIBE answers: one track, MPEG-TS over RTP."""


def encoded(
    images: list[npt.NDArray[np.uint8]],  # [H, W, 3] RGB
    fps: float,
) -> bytes:
    """MPEG-2 video in MPEG-TS: the one that OpenCV writes everywhere."""
    import cv2

    height, width = images[0].shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stream.ts"
        code = cv2.VideoWriter.fourcc(*"MPG2")
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, fps, (width, height))
        for image in images:
            writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        writer.release()
        return path.read_bytes()


class _Sender(ABC):
    """A thread that sends a stream over and over at its own pace, while it is plugged in."""

    def __init__(
        self,
        images: list[npt.NDArray[np.uint8]],  # [H, W, 3] RGB each
        fps: float,
    ) -> None:
        self.plugged_in = threading.Event()
        self.plugged_in.set()
        self._ending = threading.Event()
        stream = encoded(images, fps)
        self._datagrams = [stream[i : i + DATAGRAM] for i in range(0, len(stream), DATAGRAM)]
        self._period_s = len(images) / fps / len(self._datagrams)
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self.plugged_in.set()
        self._thread.join()

    @abstractmethod
    def _run(self) -> None:
        """The thread."""

    def _paced(self) -> Iterator[bytes]:
        """Datagrams, each at its time, until the end."""
        while True:
            for datagram in self._datagrams:
                if self._ending.wait(self._period_s):
                    return
                yield datagram


class UdpCamera(_Sender):
    """Sends to a port of this computer, whether or not anyone listens."""

    def __init__(
        self,
        port: int,
        images: list[npt.NDArray[np.uint8]],  # [H, W, 3] RGB each
        fps: float = 25.0,
    ) -> None:
        super().__init__(images, fps)
        self._address = ("127.0.0.1", port)

    def _run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for datagram in self._paced():
                if self.plugged_in.is_set():
                    sender.sendto(datagram, self._address)


class RtspCamera(_Sender):
    """An RTSP server for one client at a time, RTP interleaved in its connection (RFC 2326)."""

    def __init__(
        self,
        images: list[npt.NDArray[np.uint8]],  # [H, W, 3] RGB each
        fps: float = 25.0,
    ) -> None:
        super().__init__(images, fps)
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(0.05)
        self.url = f"rtsp://127.0.0.1:{self._server.getsockname()[1]}/camera"

    def _run(self) -> None:
        with self._server:
            while not self._ending.is_set():
                try:
                    client, _ = self._server.accept()
                except TimeoutError:
                    continue
                with client:
                    if self.plugged_in.is_set() and self._asked_to_play(client):
                        self._play(client)

    def _asked_to_play(self, client: socket.socket) -> bool:
        """Answer requests until PLAY; False if the client goes before."""
        client.settimeout(5.0)
        with client.makefile("rb") as requests:
            while line := requests.readline():
                method = line.split()[0].decode()
                headers = {}
                while (header := requests.readline().strip()) != b"":
                    key, _, value = header.decode().partition(":")
                    headers[key.lower()] = value.strip()
                client.sendall(_answer(method, headers["cseq"]))
                if method == "PLAY":
                    return True
        return False

    def _play(self, client: socket.socket) -> None:
        for number, datagram in enumerate(self._paced()):
            if not self.plugged_in.is_set():
                return
            ticks = round(number * self._period_s * 90_000)
            rtp = struct.pack(">BBHII", 0x80, RTP_MPEG_TS, number & 0xFFFF, ticks & 0xFFFFFFFF, 1)
            packet = rtp + datagram
            try:
                client.sendall(b"$\0" + struct.pack(">H", len(packet)) + packet)
            except OSError:
                return


def _answer(method: str, sequence: str) -> bytes:
    head = f"RTSP/1.0 200 OK\r\nCSeq: {sequence}\r\n"
    if method == "OPTIONS":
        head += "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
    if method == "SETUP":
        head += "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\n"
    if method in {"SETUP", "PLAY"}:
        head += "Session: 1\r\n"
    if method == "DESCRIBE":
        head += f"Content-Type: application/sdp\r\nContent-Length: {len(SDP)}\r\n"
    return f"{head}\r\n{SDP if method == 'DESCRIBE' else ''}".encode()
