"""H.264 in RTP at a UDP port, such as a BlueROV2's on 5600, read packet by packet."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.capture import RawPicture
from aquaflow.drivers.ffmpeg import rgb_of
from aquaflow.drivers.h264 import (
    KEY_PICTURE,
    PICTURE_PARAMETERS,
    SEQUENCE_PARAMETERS,
    TYPE_BITS,
    Units,
    decode,
)
from aquaflow.drivers.stream.ages import Ages
from aquaflow.drivers.stream.depacketizer import Depacketizer, ReceivedPicture
from aquaflow.drivers.stream.ffmpeg import OPEN_TIMEOUT_S
from aquaflow.drivers.stream.session import Session
from aquaflow.types import CameraModel

NEEDED = frozenset({KEY_PICTURE, SEQUENCE_PARAMETERS, PICTURE_PARAMETERS})
"""Types of the units with which decoding begins."""
LOST = "lost packets on its way"


class RtpCapture:
    """One connection: it lasts while packets come."""

    camera: CameraModel | None = None
    notes: tuple[str, ...] = ()

    def __init__(
        self,
        name: str,
        config: StreamConfig,
        session: Session,
        receiver: socket.socket,
        first: bytes,
    ) -> None:
        """Go on with a socket that the ``first`` packet came from; it is closed with this."""
        self._config, self._session, self._receiver = config, session, receiver
        self.format = f"H264 in RTP on UDP port {session.port.number}"
        self._depacketizer = Depacketizer(session.payload_type(first))
        self._ages = Ages(name, config)
        self._pictures = decode(self._receive_pictures(first))

    def read(self, timeout_s: float) -> RawPicture | None:
        """The next picture; waits up to the configured stall time for its packets.

        Raises:
            TimeoutError: no packets come.
            ConnectionError: packets come, but no picture.
        """
        picture, bgr = next(self._pictures)
        exposed_ns, stale = self._ages.judge(picture.stream_ns, picture.arrival_ns)
        shown = rgb_of(bgr) if picture.is_whole else rgb_of(None, LOST)
        return RawPicture(time.monotonic_ns(), shown, exposed_ns=exposed_ns, stale=stale)

    def close(self) -> None:
        self._pictures.close()
        self._receiver.close()

    def _receive_pictures(self, first: bytes) -> Iterator[tuple[ReceivedPicture, Units]]:
        """Pictures from the first on that can be decoded."""
        deadline_s, packet, has_begun = time.monotonic() + OPEN_TIMEOUT_S, first, False
        while True:
            for picture in self._depacketizer.add(packet, time.monotonic_ns()):
                units = picture.units
                if not has_begun:
                    units = [*self._session.parameters, *units]
                    has_begun = {each[0] & TYPE_BITS for each in units if each} >= NEEDED
                if has_begun:
                    yield picture, units
            if not has_begun and time.monotonic() > deadline_s:
                raise ConnectionError(
                    f"packets come to UDP port {self._session.port.number}, but no key picture "
                    f"within {OPEN_TIMEOUT_S:g} s; is its codec h264, and does it send key frames "
                    f"with parameters?"
                )
            packet = self._next_packet()

    def _next_packet(self) -> bytes:
        self._receiver.settimeout(self._config.stall_s)
        try:
            return self._receiver.recv(1 << 16)
        except TimeoutError as error:
            said = f"no packet came to UDP port {self._session.port.number}"
            raise TimeoutError(f"{said} for {self._config.stall_s:g} s") from error
