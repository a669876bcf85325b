"""A video stream that FFmpeg reads: RTSP, HTTP, MPEG-TS, and RTP of other codecs than H.264."""

from __future__ import annotations

import time
from collections import deque
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.clocks.device import ClockMapping
from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.capture import RawPicture
from aquaflow.drivers.ffmpeg import rgb_of, video_capture
from aquaflow.drivers.jpeg import jpeg_to_rgb
from aquaflow.drivers.stream.session import for_logs, has_stream_time, is_at_a_port
from aquaflow.types import CameraModel, EncodedPicture

MOTION_JPEG = "MJPG"
"""FFmpeg's name of a stream whose pictures are JPEG files."""
MAX_DAMAGED = 30
"""Pictures in a row that fail to decode before the stream counts as broken: 1 s."""


class StreamCapture:
    """One connection."""

    camera: CameraModel | None = None
    notes: tuple[str, ...] = ()

    def __init__(self, name: str, config: StreamConfig, source: str) -> None:
        """Connect to ``source``, which FFmpeg can open.

        Raises:
            ConnectionError: no server answers, or its data are no video.
        """
        self._stall_ns = round(config.stall_s * 1e9)
        # The first picture comes with a key frame, which may be seconds away.
        self._patience_ns = max(self._stall_ns, round(OPEN_TIMEOUT_S * 1e9))
        self._ages = Ages(name, config)
        self._stale = ""
        self._damaged = 0
        self._grabbed = False
        self._capture = open_capture(source, config)
        if not self._capture.isOpened() or not self._has_size():
            self.close()
            raise ConnectionError(f"no video from {for_logs(config.url)}{_advice(config)}")
        self.format = format_of(self._capture)
        self._width, self._height = _size(self._capture)
        self._sends_jpeg = self.format.endswith(f" {MOTION_JPEG}") and _hands_over(self._capture)

    def read(self, timeout_s: float) -> RawPicture | None:
        """The next picture; FFmpeg waits up to the configured stall time."""
        if not self._grabbed:
            self._grab()
        arrival_ns = time.monotonic_ns()
        if self._damaged > 0:
            self._damaged -= 1
            return RawPicture(arrival_ns, rgb_of(None), stale=self._stale)
        self._grabbed = False
        exposed_ns, self._stale = self._ages.judge(self._stream_ns(), arrival_ns)
        shown = None if self._stale else self._retrieve()
        if shown is None or not self._sends_jpeg:
            return RawPicture(arrival_ns, rgb_of(shown), exposed_ns, stale=self._stale)
        jpeg = shown.reshape(-1)
        return RawPicture(
            arrival_ns,
            partial(jpeg_to_rgb, jpeg, self._width, self._height),
            exposed_ns,
            received=lambda: EncodedPicture("jpeg", jpeg.tobytes()),
        )

    def close(self) -> None:
        self._capture.release()

    def _has_size(self) -> bool:
        import cv2

        return bool(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH) > 0.0)

    def _grab(self) -> None:
        """FFmpeg reports a damaged picture and the end alike; at the end no picture follows."""
        deadline_ns = time.monotonic_ns() + self._patience_ns
        since_ns = time.monotonic_ns()
        while not self._capture.grab():
            before_ns, since_ns = since_ns, time.monotonic_ns()
            # A wait that the time limit ended is no damaged picture.
            self._damaged += since_ns - before_ns < 0.9 * self._stall_ns
            if self._damaged > MAX_DAMAGED or since_ns > deadline_ns:
                raise ConnectionError("the stream ended or stalled")
        self._grabbed = True
        self._patience_ns = round(0.9 * self._stall_ns)

    def _stream_ns(self) -> int:
        """The stream's own time of the grabbed picture."""
        import cv2

        return round(1e6 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC)))

    def _retrieve(self) -> npt.NDArray[np.uint8] | None:
        """[H, W, 3] BGR, or the bytes of a JPEG file; must be fetched before the next picture is
        grabbed, used or not."""
        decoded, bgr = self._capture.retrieve()
        return bgr if decoded else None


def _size(capture: Any) -> tuple[int, int]:
    """Width and height, px."""
    import cv2

    width, height = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
    return int(capture.get(width)), int(capture.get(height))


def _hands_over(capture: Any) -> bool:
    """Let FFmpeg pass on the pictures' files as they came; False if it cannot."""
    import cv2

    return bool(capture.set(cv2.CAP_PROP_FORMAT, -1))


def _advice(config: StreamConfig) -> str:
    """What may be wrong where packets come, but no picture."""
    if not is_at_a_port(config.url):
        return ""
    return (
        f" within {OPEN_TIMEOUT_S:g} s, though packets come; is its codec {config.codec}, and does "
        f"it send key frames?"
    )


# --------------------------------------------------------------------------------------------------
# Opening a video stream with OpenCV's FFmpeg, so that pictures come as soon as they can.

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


# --------------------------------------------------------------------------------------------------
# Which pictures of a stream are too old to be used, and when the others were taken.

UNKNOWN = "the age of its pictures is not known yet"


class Ages:
    """Of the pictures of one connection."""

    def __init__(self, name: str, config: StreamConfig) -> None:
        """``name`` of the camera."""
        self._latency_ns = round(config.latency_s * 1e9)
        self._max_ns = None if config.max_age_s is None else round(config.max_age_s * 1e9)
        self._clock = StreamClock(f"stream '{name}'") if has_stream_time(config.url) else None

    def judge(self, stream_ns: int, arrival_ns: int) -> tuple[int, str]:
        """When a picture was taken, and why it is too old; empty: it is not.

        ``stream_ns`` is the stream's own time, of no meaning where it carries none.
        """
        if self._clock is None or self._max_ns is None:
            return arrival_ns - self._latency_ns, ""
        t_ns = self._clock.moment(stream_ns, arrival_ns)
        if t_ns is None:
            return arrival_ns - self._latency_ns, UNKNOWN
        age_ns = arrival_ns - t_ns + self._latency_ns
        is_old = age_ns > self._max_ns
        said = f"its pictures are {age_ns * 1e-9:.1f} s old" if is_old else ""
        return t_ns - self._latency_ns, said


# --------------------------------------------------------------------------------------------------
# When a picture of a stream was taken, by the time that the stream itself carries.
#
# A picture's arrival says nothing of its age: what a broken connection, a server or a decoder held
# back arrives late, and looks fresh. The presentation time that RTP and MPEG-TS carry does tell:
# its distance to the arrival is smallest for the picture that was held back the least, and what
# another one has more, it was late. The least distance of two minutes, the drift of the two clocks
# taken out, is :class:`aquaflow.base.clocks.device.ClockMapping`'s.

PACED = 5
"""Pictures by whose pace a connection is judged: 0.13 s at 30 pictures/s."""
PACE = 0.8
"""A stream that is read as it is filmed takes as long between its pictures as their times differ;
what was held back comes as fast as it is decoded. Between five pictures at 30 a second, 20 ms of
jitter stay above this."""
MAX_FUTURE_NS = 50_000_000
"""No picture comes before it is taken; more is a jump of the stream's time, not jitter."""
MAX_DRIFT = 0.005
"""Some cameras count pictures instead of time: 30 a second stated, and 29.97 taken, are 0.1 %."""


class StreamClock:
    """The times of one connection on CLOCK_MONOTONIC."""

    def __init__(self, name: str) -> None:
        """``name`` of the stream, for the log."""
        self._mapping = ClockMapping(name, MAX_DRIFT)
        self._recent: deque[tuple[int, int]] = deque(maxlen=PACED)
        self._resets = 0
        self._settled = False

    def moment(self, stream_ns: int, arrival_ns: int) -> int | None:
        """When a picture with the time ``stream_ns`` would have arrived, had nothing held it back.

        None while that is not known: until pictures come at the pace at which they were taken, at
        the start and after a jump of the stream's time.
        """
        self._mapping.add(stream_ns, arrival_ns)
        if self._mapping.resets != self._resets:
            self._resets, self._settled = self._mapping.resets, False
            self._recent.clear()
        self._recent.append((stream_ns, arrival_ns))
        self._settled = self._settled or self._is_paced()
        t_ns = self._mapping.to_monotonic(stream_ns)
        if not self._settled or t_ns is None or t_ns > arrival_ns + MAX_FUTURE_NS:
            return None
        return min(t_ns, arrival_ns)

    def _is_paced(self) -> bool:
        (first_ns, since_ns), (last_ns, until_ns) = self._recent[0], self._recent[-1]
        taken_ns, came_ns = last_ns - first_ns, until_ns - since_ns
        return len(self._recent) == PACED and 0 < PACE * taken_ns <= came_ns
