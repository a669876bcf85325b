"""Runs the link of one device: opens, reads, decodes, answers, and reopens it when lost."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from enum import Enum
from typing import Protocol, TypeAlias, runtime_checkable

from aquaflow.drivers.link import ByteLink, Event, LinkCounters, LinkDecoder, LinkLostError, about
from aquaflow.drivers.live import DeviceState
from aquaflow.drivers.transport import OpenLink
from aquaflow.sources import RawTap
from aquaflow.types import TelemetrySample

log = logging.getLogger(__name__)

READ_TIMEOUT_S = 0.1
"""Read timeout, after which a link checks whether it shall close."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 5.0
"""Between attempts to open a link; doubled after each that brought no byte."""

Deliver: TypeAlias = Callable[[list[TelemetrySample]], None]
"""Gets the samples of one read. Must not block."""


class SupervisedDecoder(LinkDecoder, Protocol):
    """A decoder that is reset when the stream starts anew."""

    def reset(self) -> None: ...


@runtime_checkable
class Talker(Protocol):
    """A decoder that also sends to its device."""

    def outgoing(self, now_ns: int) -> bytes:
        """The bytes to write now; often none."""
        ...


class LinkState(str, Enum):
    """States of a link."""

    WAITING = "waiting"
    """Nothing was heard of it yet."""
    CONNECTED = "connected"
    LOST = "lost"
    """It was heard, and is not any more."""
    CLOSED = "closed"


class Supervisor:
    """Runs :meth:`run` in its own thread until :meth:`stop`; no error leaves it."""

    def __init__(
        self,
        name: str,
        open_link: OpenLink,
        decoder: SupervisedDecoder,
        deliver: Deliver,
        tap: RawTap | None = None,
        silence_s: float | None = None,
    ) -> None:
        self.name = name
        self.state = LinkState.WAITING
        self.reason = "nothing heard yet"
        """Why it is not connected, for people."""
        self.flow = DeviceState()
        self.is_open = False
        self._open_link = open_link
        self._decoder = decoder
        self._deliver = deliver
        self._tap = tap
        self._silence_s = silence_s
        self._stopping = threading.Event()
        self._pause_s = FIRST_PAUSE_S
        self._heard_before = False

    @property
    def counters(self) -> LinkCounters:
        """The decoder's counts so far."""
        return self._decoder.counters

    def stop(self) -> None:
        """Ask :meth:`run` to return; it does within one read."""
        self._stopping.set()

    def run(self) -> None:
        """Serve the link, and open it anew when it is lost, until stopped."""
        while not self._stopping.is_set():
            try:
                self._serve_one_link()
            except LinkLostError as error:
                self._note_lost(str(error))
            # The thread has no caller to raise to, and the other links continue.
            except Exception as error:
                log.exception(
                    "%s: the driver failed; the link is opened anew", self.name,
                    extra=about(self.name, "failed"),
                )  # fmt: skip
                self._note_lost(f"the driver failed: {error}")
            self._stopping.wait(self._pause_s)
            self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
        self.state, self.reason = LinkState.CLOSED, ""

    def _serve_one_link(self) -> None:
        """Serve one link from opening it until it is lost, or until :meth:`stop`."""
        link = self._open_link()
        self._decoder.reset()
        self.is_open = True
        try:
            self._serve(link)
        finally:
            self.is_open = False
            link.close()

    def _serve(self, link: ByteLink) -> None:
        heard, last_s = False, time.monotonic()
        while not self._stopping.is_set():
            self._answer(link)
            data = link.read(READ_TIMEOUT_S)
            arrival_ns = time.monotonic_ns()
            if data:
                if not heard:
                    self._note_heard()
                heard, last_s = True, time.monotonic()
                self._take(data, arrival_ns)
            elif self._silence_s is not None and time.monotonic() - last_s > self._silence_s:
                raise LinkLostError(f"no byte for {self._silence_s:g} s")
        self._answer(link)  # what was to be sent before the end

    def _take(self, data: bytes, arrival_ns: int) -> None:
        if self._tap is not None:
            self._tap(self.name, arrival_ns, data)
        samples = self._decoder.feed(data, arrival_ns)
        if samples:
            for sample in samples:
                self.flow.record(sample.t_ns, arrival_ns)
            self._deliver(samples)

    def _answer(self, link: ByteLink) -> None:
        if isinstance(self._decoder, Talker):
            data = self._decoder.outgoing(time.monotonic_ns())
            if data:
                link.write(data)

    def _note_heard(self) -> None:
        """The link is up; one that opens but stays silent is not."""
        again = self._heard_before
        self.counters.reconnects += again
        self._heard_before = True
        self._pause_s = FIRST_PAUSE_S
        if self.state is not LinkState.CONNECTED:
            self.state, self.reason = LinkState.CONNECTED, ""
            event: Event = "reconnected" if again else "connected"
            self._tell(event, event, logging.INFO)

    def _note_lost(self, reason: str) -> None:
        """The link is down; a reason that was told already is not told again."""
        event: Event = "lost" if self.state is LinkState.CONNECTED else "waiting"
        self.state = LinkState.LOST if self._heard_before else LinkState.WAITING
        if reason != self.reason:
            self.reason = reason
            self._tell(event, reason, logging.WARNING)

    def _tell(self, event: Event, text: str, level: int) -> None:
        log.log(level, "%s: %s", self.name, text, extra=about(self.name, event))
