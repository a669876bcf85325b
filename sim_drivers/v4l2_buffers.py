"""The buffers of the simulated V4L2 camera, with the order of calls that the kernel insists on."""

from __future__ import annotations

import errno
import os
import threading
from collections import deque
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

PAGE_BITS = 12
"""Piece n of the memory is mapped at offset n << PAGE_BITS."""


def refusal(number: int) -> OSError:
    """As the kernel refuses."""
    return OSError(number, os.strerror(number))


class Buffers:
    """Memory-mapped buffers: requested, queued, started, filled, queued again."""

    def __init__(self) -> None:
        self.memory: list[npt.NDArray[np.uint8]] = []
        """The pieces of the first buffer, then those of the second."""
        self._pieces = 1
        self._queued: deque[int] = deque()
        self._on = False
        self._lock = threading.Lock()

    def request(self, count: int, sizes: Sequence[int]) -> None:
        """VIDIOC_REQBUFS: ``count`` buffers of pieces of these sizes; EBUSY while streaming."""
        if self._on:
            raise refusal(errno.EBUSY)
        self._pieces = len(sizes)
        self.memory = [np.zeros(size, np.uint8) for _ in range(count) for size in sizes]

    def existing(self, index: int) -> int:
        """``index``, or EINVAL if there is no such buffer."""
        if index * self._pieces >= len(self.memory):
            raise refusal(errno.EINVAL)
        return index

    def queue(self, index: int) -> None:
        """VIDIOC_QBUF: the buffer may be filled."""
        with self._lock:
            if self.existing(index) in self._queued:
                raise refusal(errno.EINVAL)
            self._queued.append(index)

    def start(self) -> None:
        """VIDIOC_STREAMON."""
        if not self._queued:
            raise refusal(errno.EINVAL)
        self._on = True

    def stop(self) -> None:
        """VIDIOC_STREAMOFF: no buffer is queued afterwards."""
        self._on = False
        self._queued.clear()

    def ready(self) -> bool:
        """True if there is a buffer for the next picture; refuses before the start."""
        if not self._on:
            raise refusal(errno.EINVAL)
        return bool(self._queued)

    def fill(self, payloads: Sequence[npt.NDArray[np.uint8]]) -> int:  # each [bytes]
        """The buffer that holds ``payloads`` now, and belongs to the program."""
        with self._lock:
            index = self._queued.popleft()
        for piece, payload in enumerate(payloads, self._pieces * index):
            self.memory[piece][: payload.size] = payload
        return index
