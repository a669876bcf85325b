"""The buffers of the simulated V4L2 camera, with the order of calls that the kernel insists on."""

from __future__ import annotations

import errno
import os
import threading
from collections import deque

import numpy as np
import numpy.typing as npt

PAGE_BITS = 12
"""Buffer n is mapped at offset n << PAGE_BITS."""


def refused(number: int) -> OSError:
    """As the kernel refuses."""
    return OSError(number, os.strerror(number))


class Buffers:
    """Memory-mapped buffers: requested, queued, started, filled, queued again."""

    def __init__(self) -> None:
        self.memory: list[npt.NDArray[np.uint8]] = []
        self._queued: deque[int] = deque()
        self._on = False
        self._lock = threading.Lock()

    def request(self, count: int, size: int) -> None:
        """VIDIOC_REQBUFS: make ``count`` buffers; EBUSY while streaming."""
        if self._on:
            raise refused(errno.EBUSY)
        self.memory = [np.zeros(size, np.uint8) for _ in range(count)]

    def existing(self, index: int) -> int:
        """``index``, or EINVAL if there is no such buffer."""
        if index >= len(self.memory):
            raise refused(errno.EINVAL)
        return index

    def queue(self, index: int) -> None:
        """VIDIOC_QBUF: the buffer may be filled."""
        with self._lock:
            if self.existing(index) in self._queued:
                raise refused(errno.EINVAL)
            self._queued.append(index)

    def start(self) -> None:
        """VIDIOC_STREAMON."""
        if not self._queued:
            raise refused(errno.EINVAL)
        self._on = True

    def stop(self) -> None:
        """VIDIOC_STREAMOFF: no buffer is queued afterwards."""
        self._on = False
        self._queued.clear()

    def ready(self) -> bool:
        """True if there is a buffer for the next picture; refuses before the start."""
        if not self._on:
            raise refused(errno.EINVAL)
        return bool(self._queued)

    def fill(self, payload: npt.NDArray[np.uint8]) -> int:  # [bytes]
        """The buffer that holds ``payload`` now, and belongs to the program."""
        with self._lock:
            index = self._queued.popleft()
        self.memory[index][: payload.size] = payload
        return index
