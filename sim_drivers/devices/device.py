"""A simulated device: sends the samples of a log in its own protocol, in time, and answers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from typing import Generic, Protocol, TypeAlias, TypeVar

from aquaflow.types import TelemetrySample

Packet = TypeVar("Packet")
"""bytes on serial lines and sockets, can.Message on a bus."""

Clock: TypeAlias = Callable[[int], int]
"""Nanoseconds since the device started to what its own clock then shows."""

POLL_S = 0.005
"""How soon a request is answered."""
CLOSE_TIMEOUT_S = 5.0
"""The thread looks every POLL_S whether it shall end; one that is stuck is left behind."""


class DeviceProtocol(Protocol[Packet]):
    """What a device sends; times are of its own clock."""

    def encode(self, sample: TelemetrySample, measured_ns: int, now_ns: int) -> list[Packet]:
        """Packets that carry ``sample``; none if the protocol has no message for it."""
        ...

    def answer(self, packet: Packet, now_ns: int) -> list[Packet]:
        """Answers to what came in."""
        ...

    def due_packets(self, now_ns: int) -> list[Packet]:
        """Packets that are due now without a request, such as heartbeats."""
        ...


class Wire(Protocol[Packet]):
    """The device's end of a link."""

    def send(self, packet: Packet) -> None:
        """Send the packet; it is lost if the other end is closed. Never raises."""
        ...

    def receive(self) -> Packet | None:
        """What has come in, without waiting."""
        ...

    def close(self) -> None: ...


def boot_clock(since_start_ns: int) -> int:
    """A device that was switched on ten minutes before."""
    return 600_000_000_000 + since_start_ns


class SimulatedDevice(Generic[Packet]):
    """Runs in a thread until closed.

    Args:
        samples: in the order of arrival; the first is sent at once.
        speed: of time, 1: as it was; None: as fast as the wire takes them.
        clock: the device's own clock.
    """

    def __init__(
        self,
        protocol: DeviceProtocol[Packet],
        wire: Wire[Packet],
        samples: Iterable[TelemetrySample],
        speed: float | None = 1.0,
        clock: Clock = boot_clock,
    ) -> None:
        self.sent = 0
        """Packets sent."""
        self.finished = threading.Event()
        """Set once all samples are sent; requests are answered until it is closed."""
        self._protocol, self._wire, self._samples = protocol, wire, samples
        self._speed, self._clock = speed, clock
        self._stopping = threading.Event()
        self._started_ns = time.monotonic_ns()
        self._elapsed_ns = 0
        self._thread = threading.Thread(target=self._run, name="simulated device", daemon=True)

    def start(self) -> SimulatedDevice[Packet]:
        """Begin to send, in a thread."""
        self._started_ns = time.monotonic_ns()
        self._thread.start()
        return self

    def close(self) -> None:
        """Stop sending and close the wire."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join(CLOSE_TIMEOUT_S)
        self._wire.close()

    def _run(self) -> None:
        first_ns: int | None = None
        for sample in self._samples:
            first_ns = sample.arrival_ns if first_ns is None else first_ns
            self._wait_until(sample.arrival_ns - first_ns)
            if self._stopping.is_set():
                return
            measured_ns = self._clock(sample.t_ns - first_ns)
            self._send(self._protocol.encode(sample, measured_ns, self._now_ns()))
        self.finished.set()
        while not self._stopping.wait(POLL_S):
            self._exchange()

    def _wait_until(self, elapsed_ns: int) -> None:
        """Exchange packets until the log has reached ``elapsed_ns``."""
        if self._speed is None:
            self._elapsed_ns = elapsed_ns
            self._exchange()
            return
        while not self._stopping.is_set():
            self._exchange()
            left_s = (elapsed_ns - self._now_in_log_ns()) / self._speed * 1e-9
            if left_s <= 0:
                return
            self._stopping.wait(min(left_s, POLL_S))

    def _now_in_log_ns(self) -> int:
        if self._speed is None:
            return self._elapsed_ns
        return round((time.monotonic_ns() - self._started_ns) * self._speed)

    def _now_ns(self) -> int:
        return self._clock(self._now_in_log_ns())

    def _exchange(self) -> None:
        self._send(self._protocol.due_packets(self._now_ns()))
        while (packet := self._wire.receive()) is not None:
            self._send(self._protocol.answer(packet, self._now_ns()))

    def _send(self, packets: list[Packet]) -> None:
        for packet in packets:
            self._wire.send(packet)
            self.sent += 1


class OneWayDevice(Generic[Packet]):
    """A device that only sends samples: no answers, nothing unprompted."""

    def answer(self, packet: Packet, now_ns: int) -> list[Packet]:
        return []

    def due_packets(self, now_ns: int) -> list[Packet]:
        return []
