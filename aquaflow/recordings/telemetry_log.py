"""What all telemetry logs on disk have in common, and the byte logs among them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar, NamedTuple

from aquaflow.base.clocks.wall import JUMP_NS
from aquaflow.config.telemetry import AnyDevice
from aquaflow.drivers.link import LinkCounters
from aquaflow.drivers.mounting import BodyFrame, Mounting
from aquaflow.drivers.samples import plausible
from aquaflow.drivers.telemetry import decoder_of
from aquaflow.sources import RawTap
from aquaflow.types import TelemetrySample, UtcTime

LONGEST_PAUSE_NS = 3600 * 1_000_000_000
"""Logs carry wall clock times; a longer step, or one back, is the clock being set."""
UTC_EVERY_NS = 10 * 1_000_000_000
"""How often the wall clock of a log becomes a sample: it says the same each time."""


class LogTime:
    """Wall clock stamps of a log as time since its first: never backwards, no jumps."""

    def __init__(self, starts_s: float = 0.0) -> None:
        """The first stamp becomes ``starts_s``."""
        self.jumps = 0
        self._now_ns = round(starts_s * 1e9)
        self._stamp_ns: int | None = None

    def at(self, stamp_ns: int) -> int:
        """The next stamp of the log on the dive's clock, ns."""
        step = 0 if self._stamp_ns is None else stamp_ns - self._stamp_ns
        self._stamp_ns = stamp_ns
        if 0 <= step <= LONGEST_PAUSE_NS:
            self._now_ns += step
        else:
            self.jumps += 1
        return self._now_ns


class TelemetryLog(ABC):
    """A file of telemetry as a recorded source; times count from its first record."""

    specificity = 1
    suffixes: ClassVar[frozenset[str]]

    def __init__(self, path: Path, starts_s: float = 0.0) -> None:
        """``starts_s`` is when the log begins, on the clock of its video."""
        self.path = path
        self.starts_s = starts_s
        self.notes: list[str] = []

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() in cls.suffixes

    @classmethod
    def open(cls, path: Path, starts_s: float = 0.0) -> TelemetryLog:
        return cls(path, starts_s)

    @abstractmethod
    def samples(self) -> Iterator[TelemetrySample]:
        """All samples in the order of arrival; from the beginning each time."""

    def close(self) -> None:  # noqa: B027
        """Nothing stays open between passes."""


class Read(NamedTuple):
    """What one read of a link returned."""

    link: str
    arrival_ns: int
    data: bytes
    wall_ns: int | None = None
    """The wall clock of who wrote the log, ns since 1970, where it states one."""


class LoggedUtc:
    """UTC from the wall clock of a log; nothing of one that was set on the way: either could be
    right."""

    def __init__(self, source: str, times: Iterator[tuple[int, int | None]]) -> None:
        """``times``: all arrivals with the wall clock, of a pass through the log before it is
        read."""
        least, most = math.inf, -math.inf
        for arrival_ns, wall_ns in times:
            if wall_ns is not None:
                least, most = min(least, wall_ns - arrival_ns), max(most, wall_ns - arrival_ns)
        self._usable = 0 <= most - least < JUMP_NS
        self._source, self._due_ns = source, -math.inf

    def at(self, arrival_ns: int, wall_ns: int | None) -> list[TelemetrySample]:
        """The sample that is due at this record, if any."""
        if not self._usable or wall_ns is None or arrival_ns < self._due_ns:
            return []
        self._due_ns = arrival_ns + UTC_EVERY_NS
        utc = UtcTime(arrival_ns, arrival_ns, self._source, wall_ns)
        return [utc] if plausible(utc) else []


class ByteLog(TelemetryLog):
    """Recorded bytes of one device, through the decoder that its live link has."""

    _tap: RawTap | None = None

    def __init__(self, path: Path, starts_s: float = 0.0, device: AnyDevice | None = None) -> None:
        """``device`` says what speaks in the log; None: the usual."""
        super().__init__(path, starts_s)
        self.device = self.usual_device() if device is None else device
        self.counters = LinkCounters()

    @staticmethod
    @abstractmethod
    def usual_device() -> AnyDevice:
        """What mostly speaks in such logs."""

    @abstractmethod
    def reads(self) -> Iterator[Read]:
        """The bytes with their arrival, in order."""

    def tap_bytes(self, tap: RawTap) -> None:
        """Hand the bytes of every read to ``tap`` as well, as a live link does."""
        self._tap = tap

    def samples(self) -> Iterator[TelemetrySample]:
        decoded = DecodedReads({self.path.stem: self.device}, self._tap)
        self.counters = decoded.counters[self.path.stem]
        times = ((read.arrival_ns, read.wall_ns) for read in self.reads())
        utc = LoggedUtc(f"{self.path.stem}/log", times)
        for read in self.reads():
            yield from utc.at(read.arrival_ns, read.wall_ns)
            yield from decoded.of(read)


class DecodedReads:
    """The way of a live link's bytes, for recorded ones: tap, decoder, mounting."""

    def __init__(self, devices: dict[str, AnyDevice], tap: RawTap | None = None) -> None:
        """Raises InputError if a library is missing, ConfigError if a DBC file is wrong."""
        self._tap = tap
        self._decoders = {name: decoder_of(name, device) for name, device in devices.items()}
        self._mountings = {name: Mounting(device.mounting) for name, device in devices.items()}
        self._body = BodyFrame()
        self.counters = {name: decoder.counters for name, decoder in self._decoders.items()}

    def samples(self, reads: Iterator[Read]) -> Iterator[TelemetrySample]:
        """Samples in the body frame."""
        for read in reads:
            yield from self.of(read)

    def of(self, read: Read) -> Iterator[TelemetrySample]:
        """Samples of one read; one of a link that no device is known for passes the tap."""
        if self._tap is not None:
            self._tap(read.link, read.arrival_ns, read.data)
        decoder = self._decoders.get(read.link)
        if decoder is not None:
            for sample in decoder.feed(read.data, read.arrival_ns):
                yield self._body.refer(sample, self._mountings[read.link])
