"""A video stream as a live CameraSource."""

from __future__ import annotations

from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.capture import Capture
from aquaflow.drivers.live import LiveCamera
from aquaflow.drivers.stream.capture import StreamCapture
from aquaflow.drivers.stream.rtp_capture import RtpCapture
from aquaflow.drivers.stream.session import is_at_a_port, session_of
from aquaflow.drivers.stream.udp_port import bound, check_next_port, first_packet


class StreamCamera(LiveCamera):
    """The newest picture of a stream; connects again whenever it breaks."""

    def __init__(self, name: str, config: StreamConfig) -> None:
        super().__init__(name, config, lambda: open_stream(name, config))

    @classmethod
    def from_config(cls, name: str, config: StreamConfig) -> StreamCamera:
        """The camera of :func:`aquaflow.sources.open_camera`."""
        return cls(name, config)


# --------------------------------------------------------------------------------------------------
# Which reader a stream needs: ours for H.264 in RTP at a port, FFmpeg for all else.

MPEG_TS = 0x47
"""First byte of each packet of MPEG-TS."""


def open_stream(name: str, config: StreamConfig) -> Capture:
    """Connect to the stream of the camera ``name``.

    Raises:
        ConnectionError: no server answers, a port is taken, or what comes is no video.
        FileNotFoundError: there is no such SDP file.
    """
    if not is_at_a_port(config.url):
        return StreamCapture(name, config, config.url)
    session = session_of(config)
    receiver = bound(session.port)
    try:
        packet = first_packet(receiver, session.port)
        is_bare = packet[0] != MPEG_TS
        payload_type = session.payload_type(packet) if is_bare else 0
        if session.is_h264(payload_type):
            return RtpCapture(name, config, session, receiver, packet)
    except OSError:
        receiver.close()
        raise
    receiver.close()  # FFmpeg opens the port itself
    if not is_bare:
        return StreamCapture(name, config, config.url)
    check_next_port(session.port)
    return StreamCapture(name, config, session.data_url(payload_type))
