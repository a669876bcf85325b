"""The newest picture of the mapping camera for a web page: made when somebody asks for it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from aquaflow.live.service_status import ServiceStatus
from aquaflow.types import Frame

WIDTH = 640
"""Most pixels across: enough to see where the camera looks, and 40 to 100 kB."""
QUALITY = 80
"""Of JPEG; artefacts begin to show below."""
SPACING_S = 0.5
"""Between two encodings, however many ask: two pictures of 640 px a second cost 1 % of a core."""


class NewestPicture:
    """A watcher of the service, and what answers GET /picture.jpg."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self.encoded = 0
        """Pictures that were encoded."""
        self._now_s, self._made_s = now_s, -SPACING_S
        self._newest: Frame | None = None
        self._jpeg: tuple[Frame, bytes] | None = None
        self._making = threading.Lock()

    def update(self, service: ServiceStatus) -> None:
        """Called after every turn of the service; never waits."""
        self._newest = service.picture or self._newest

    def jpeg(self) -> bytes | None:
        """The newest picture, or one that was the newest ``SPACING_S`` ago; None before the
        first."""
        with self._making:
            frame, now = self._newest, self._now_s()
            if frame is None:
                return None
            made = self._jpeg
            if made is not None and (made[0] is frame or now - self._made_s < SPACING_S):
                return made[1]
            self._jpeg, self._made_s = (frame, _encode(frame)), now
            self.encoded += 1
            return self._jpeg[1]


def _encode(frame: Frame) -> bytes:
    import cv2

    image = frame.image
    height, width = image.shape[:2]
    if width > WIDTH:
        size = (WIDTH, max(1, round(height * WIDTH / width)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done  # of three channels of bytes it always is
    return bytes(data)
