"""What simulated cameras show: the pictures of any recording, with faults put in between.

Every fault happens at the sequence number that it names, so that a test gets the same one twice.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import numpy.typing as npt

from aquaflow.sources import CameraSource
from aquaflow.types import Frame

NS_PER_S = 1_000_000_000
"""Nanoseconds of a second."""


@dataclass(frozen=True)
class CameraFaults:
    """What goes wrong, by the camera's own picture counter."""

    drop: frozenset[int] = frozenset()
    """Counted by the camera and never delivered."""
    duplicate: frozenset[int] = frozenset()
    """Delivered twice with the same number and time."""
    delay_s: dict[int, float] = field(default_factory=dict)
    """Exposed in time, delivered late; those behind it wait."""
    corrupt: frozenset[int] = frozenset()
    """Delivered with damaged bytes."""
    disconnect: frozenset[int] = frozenset()
    """Unplugged instead of delivering this one."""
    away_s: float = 0.05
    """Until it is plugged in again."""
    clock_jump_s: dict[int, float] = field(default_factory=dict)
    """From this picture on, the claimed times are off by so much more."""
    flood: range = range(0)
    """Delivered at once, as after a blocked cable."""


@dataclass(frozen=True)
class Shot:
    """One picture as the simulated camera has it."""

    sequence: int
    image: npt.NDArray[np.uint8]
    """[H, W, 3] RGB."""
    due_ns: int
    """CLOCK_MONOTONIC: when it can be delivered."""
    exposed_ns: int
    """What the camera claims."""
    true_ns: int
    """When it was exposed in truth."""
    corrupt: bool = False
    unplugged: bool = False
    """No picture at all: the device is gone from here on."""


class CameraFeed:
    """Shots in the order of delivery, in real time; the recording starts again where it ends."""

    def __init__(
        self,
        source: CameraSource,
        fps: float = 30.0,
        faults: CameraFaults | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.faults = faults or CameraFaults()
        self.away_until_ns = 0
        self._source = source
        self._now_ns = now_ns
        self._period_ns = round(NS_PER_S / fps)
        self._jump_ns = 0
        self._shots = self._forever()
        self._next: Shot | None = None

    @property
    def plugged_in(self) -> bool:
        """False while the simulated device is away."""
        return self._now_ns() >= self.away_until_ns

    def come_back(self) -> None:
        """The device was away until now: what it did not show meanwhile never comes."""
        self.away_until_ns = self._now_ns()

    def set_clock_on(self, seconds: float) -> None:
        """From the next picture on, the claimed times are off by so much more."""
        self._jump_ns += round(seconds * NS_PER_S)

    def peek(self) -> Shot:
        """The next shot, which may not be due yet."""
        if self._next is None:
            self._next = next(self._shots)
        return self._next

    def take(self) -> Shot:
        """The next shot. One that is ``unplugged`` also sets how long the device is away."""
        shot, self._next = self.peek(), None
        if shot.unplugged:
            self.away_until_ns = self._now_ns() + round(self.faults.away_s * NS_PER_S)
        return shot

    def wait(self, timeout_s: float) -> bool:
        """Sleep until the next shot is due; False if that takes longer than ``timeout_s``."""
        left_s = (self.peek().due_ns - self._now_ns()) / NS_PER_S
        time.sleep(max(0.0, min(left_s, timeout_s)))
        return left_s <= timeout_s

    def _forever(self) -> Iterator[Shot]:
        faults = self.faults
        base_ns = self._now_ns()
        for sequence, image in enumerate(self._images()):
            true_ns = base_ns + sequence * self._period_ns
            if true_ns < self.away_until_ns:  # the device was away: nothing piled up meanwhile
                base_ns += self._now_ns() - true_ns
                true_ns = base_ns + sequence * self._period_ns
            due_ns = true_ns + round(faults.delay_s.get(sequence, 0.0) * NS_PER_S)
            if sequence in faults.flood:
                due_ns = base_ns + faults.flood[-1] * self._period_ns
            self._jump_ns += round(faults.clock_jump_s.get(sequence, 0.0) * NS_PER_S)
            claimed_ns = true_ns + self._jump_ns
            if sequence in faults.disconnect:
                yield Shot(sequence, image, due_ns, claimed_ns, true_ns, unplugged=True)
            elif sequence not in faults.drop:
                shot = Shot(
                    sequence, image, due_ns, claimed_ns, true_ns, sequence in faults.corrupt
                )
                yield shot
                if sequence in faults.duplicate:
                    yield shot

    def _images(self) -> Iterator[npt.NDArray[np.uint8]]:
        while True:
            seen = 0
            for frame in self._source.frames():
                if isinstance(frame, Frame):
                    seen += 1
                    yield frame.image
            if seen == 0:
                raise ValueError("the recording holds no picture")


def first_images(source: CameraSource, count: int) -> list[npt.NDArray[np.uint8]]:
    """The first ``count`` pictures of a recording."""
    return [f.image for f in islice(source.frames(), count) if isinstance(f, Frame)]
