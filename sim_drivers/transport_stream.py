"""A network camera that sends bare MPEG-TS over UDP."""

from __future__ import annotations

import socket
import tempfile
import threading
from pathlib import Path

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

DATAGRAM = 7 * 188
"""Bytes: as many packets of MPEG-TS as fit into one Ethernet frame."""


def encode(
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


class UdpCamera:
    """Sends a stream over and over to a port of this computer, whether or not anyone listens."""

    def __init__(
        self,
        port: int,
        images: list[npt.NDArray[np.uint8]],  # [H, W, 3] RGB each
        fps: float = 25.0,
    ) -> None:
        self._address = ("127.0.0.1", port)
        self.plugged_in = threading.Event()
        self.plugged_in.set()
        self._ending = threading.Event()
        stream = encode(images, fps)
        self._datagrams = [stream[i : i + DATAGRAM] for i in range(0, len(stream), DATAGRAM)]
        self._period_s = len(images) / fps / len(self._datagrams)
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self._ending.is_set():
                for datagram in self._datagrams:
                    if self._ending.wait(self._period_s):
                        return
                    if self.plugged_in.is_set():
                        sender.sendto(self.packet(datagram), self._address)

    def packet(self, datagram: bytes) -> bytes:
        """What is sent for ``datagram``: as it is, unless somebody wraps it."""
        return datagram
