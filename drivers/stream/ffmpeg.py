"""Opening a video stream with OpenCV's FFmpeg, so that pictures come as soon as they can."""

from __future__ import annotations

from typing import Any

from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.ffmpeg import video_capture

OPEN_TIMEOUT_S = 15.0
"""Longest wait for a stream to open."""
ANALYSE_S = 12.0
"""Longest wait for a stream's parameters in its pictures: BlueOS sends them in RTP every 10 s
(mavlink-camera-manager: rtph264pay config-interval=10), and then with the next key frame."""

PROTOCOLS = "data,udp,rtp,rtsp,rtsps,http,https,tcp,tls,crypto"
"""What FFmpeg may open: nothing that a stream names may be a file."""

LOW_DELAY = {
    # Neither what was read to analyse the stream is kept, nor are packets waited for that come in
    # the wrong order: on a tether, a missing one is lost.
    "fflags": "nobuffer",
    "reorder_queue_size": "0",
    "max_delay": "0",
    # Nobody asks for the frame rate; finding it took 0.6 s. Size and codec are waited for.
    "fpsprobesize": "0",
    "analyzeduration": str(round(ANALYSE_S * 1e6)),
    "probesize": "30000000",
    "allowed_media_types": "video",
    "protocol_whitelist": PROTOCOLS,
}
"""FFmpeg's options: analyzeduration in us, probesize in bytes (20 Mbit/s for ANALYSE_S)."""


def open_capture(source: str, config: StreamConfig) -> Any:
    """A ``cv2.VideoCapture`` on ``source``; that may not be open, or know no size."""
    import cv2

    limits = [
        *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(OPEN_TIMEOUT_S * 1e3)),
        *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(config.stall_s * 1e3)),
    ]
    return video_capture(source, {**LOW_DELAY, "rtsp_transport": config.transport}, limits)


def format_of(capture: Any) -> str:
    """Size and codec of an open stream, as FFmpeg names them."""
    import cv2

    width, height, code = (
        int(capture.get(each))
        for each in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FOURCC)
    )
    codec = (code & 0xFFFFFFFF).to_bytes(4, "little").decode("ascii", "replace").strip("\0 ")
    return f"{width} x {height} {codec}"
