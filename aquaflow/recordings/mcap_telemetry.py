"""Telemetry of an MCAP recording: the decoded samples, or the links' bytes decoded once more."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.config.telemetry import AnyDevice
from aquaflow.recordings.mcap_camera import McapCamera, Payloads, UnreadablePayloadError
from aquaflow.recordings.mcap_messages import McapMessage, McapMessages, mcap_files
from aquaflow.recordings.rosbag import stamp_of
from aquaflow.recordings.rosbag_telemetry import CONVERSIONS
from aquaflow.recordings.telemetry_lines import sample_from_json
from aquaflow.recordings.telemetry_log import DecodedReads, LoggedUtc, Read
from aquaflow.types import KINDS, TelemetrySample

TELEMETRY = "/telemetry/"
"""The recorder writes samples to topics below this one."""
LINKS = "/links/"
"""And what links received, as it came, below this one."""


class McapTelemetry:
    """Samples of all sources in the order of arrival; times count from the first picture."""

    specificity = 2

    def __init__(self, path: Path, origin_ns: int | None = None) -> None:
        """``origin_ns`` becomes time 0; None: that of the first picture, else of the first message.

        Raises:
            InputError: the extra ``recording`` is missing.
        """
        self.path = path
        self._messages = McapMessages(mcap_files(path))
        self.origin_ns = self._origin(None) if origin_ns is None else origin_ns
        self.invalid = 0
        """Messages that are no samples."""

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return McapCamera.recognises(path)

    @classmethod
    def open(cls, path: Path, starts_s: float = 0.0) -> McapTelemetry:
        telemetry = cls(path)
        telemetry.origin_ns -= round(starts_s * 1e9)
        return telemetry

    def follow(self, fps: float | None, topic: str | None) -> None:
        """Times count from the first picture of ``topic``."""
        if topic is not None:
            self.origin_ns += self._origin(topic) - self._origin(None)

    def samples(self) -> Iterator[TelemetrySample]:
        """The samples as they were decoded during the dive; of ROS's messages, as of a bag."""
        self.invalid = 0
        payloads = Payloads()
        utc = LoggedUtc(f"{self.path.stem}/bag", iter([(0, self.origin_ns)]))
        for message in self._messages:
            if not message.topic.startswith(TELEMETRY):
                yield from self._of_ros(message, payloads, utc)
                continue
            kind = message.topic.rpartition("/")[2]
            try:
                if kind not in KINDS:
                    raise ValueError(f"unknown kind {kind}")
                sample = sample_from_json(kind, message.data)
            except ValueError:
                self.invalid += 1
                continue
            yield replace(
                sample,
                t_ns=sample.t_ns - self.origin_ns,
                arrival_ns=sample.arrival_ns - self.origin_ns,
            )

    def _of_ros(
        self, message: McapMessage, payloads: Payloads, utc: LoggedUtc
    ) -> Iterator[TelemetrySample]:
        name = "" if message.schema is None else message.schema.name
        convert = CONVERSIONS.get(name if "/msg/" in name else name.replace("/", "/msg/", 1))
        if convert is None:
            return
        arrival_ns = message.log_ns - self.origin_ns
        yield from utc.at(arrival_ns, message.log_ns)
        try:
            fields = payloads.decode(message)
            t_ns = min(stamp_of(fields, message.log_ns) - self.origin_ns, arrival_ns)
            found = convert(fields, t_ns, arrival_ns, message.topic.strip("/"))
        except (UnreadablePayloadError, ValueError, ZeroDivisionError, AttributeError):
            self.invalid += 1
            return
        yield from found

    def link_bytes(self) -> Iterator[Read]:
        """Every read of every link, as it came."""
        for message in self._messages.of(lambda topic: topic.startswith(LINKS)):
            arrival_ns = message.log_ns - self.origin_ns
            yield Read(message.topic[len(LINKS) :], arrival_ns, message.data)

    def decoded_again(self, devices: dict[str, AnyDevice]) -> Iterator[TelemetrySample]:
        """Samples from the links' bytes, through the live links' decoders.

        Raises:
            InputError: a decoder's library is missing.
        """
        yield from DecodedReads(devices).samples(self.link_bytes())

    @property
    def notes(self) -> list[str]:
        """What was left out, complete once iteration ends."""
        bad = [f"{self.invalid} samples of {self.path.name} make no sense"] if self.invalid else []
        return self._messages.notes + bad

    def close(self) -> None:
        """Nothing stays open between passes."""

    def _origin(self, topic: str | None) -> int:
        try:
            return McapCamera(self.path, topic=topic).origin_ns
        except InputError:
            first = next(iter(self._messages), None)
            return 0 if first is None else first.log_ns
