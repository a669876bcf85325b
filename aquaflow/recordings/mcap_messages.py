"""Messages of MCAP files, also of those that were cut off: file order, nothing needs the index."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, cast

from aquaflow.base.errors import InputError

if TYPE_CHECKING:
    from mcap.records import Channel, Chunk, McapRecord, Message, Schema

SUFFIX = ".mcap"
"""Of an MCAP file."""

RECORD_LIMIT = 1 << 28
"""bytes; a damaged length must not fill the memory."""

HEAD = 2000
"""Messages in which every topic shows itself: of 200 a second, those of 10 s."""

ATTEMPTS = 2
"""At a chunk, which may hold a second of pictures."""


def require_mcap() -> None:
    """Check that the libraries of the extra ``recording`` are installed.

    Raises:
        InputError: mcap or foxglove's schemas are not installed.
    """
    for module in ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf"):
        if find_spec(module) is None:
            raise InputError(
                f"MCAP files need {module}; install it with pip install 'aquaflow[recording]'"
            )


@dataclass(frozen=True)
class McapMessage:
    """One message with what is needed to decode it."""

    topic: str
    encoding: str
    schema: Schema | None
    log_ns: int
    publish_ns: int
    number: int
    data: bytes
    file: str


def mcap_files(path: Path) -> list[Path]:
    """The file, or the recorder's files in a folder, in order."""
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.suffix.lower() == SUFFIX)
    return [path] if path.suffix.lower() == SUFFIX else []


class McapMessages:
    """Reads files one after the other; damaged parts are skipped and reported in ``notes``."""

    def __init__(self, files: list[Path]) -> None:
        """Open nothing yet.

        Raises:
            InputError: the extra ``recording`` is not installed.
        """
        require_mcap()
        self.files = files
        self.notes: list[str] = []
        self.facts: dict[str, dict[str, str]] = {}
        """Metadata records by name, as far as they have been read."""

    def __iter__(self) -> Iterator[McapMessage]:
        return self.of(lambda topic: True)

    def of(self, wanted: Callable[[str], bool]) -> Iterator[McapMessage]:
        """Messages whose topic is ``wanted``; a file that cannot be opened is a note.

        Raises:
            InputError: a file is no MCAP file.
        """
        self.notes = []
        for file in self.files:
            try:
                yield from self._messages(file, wanted)
            except OSError as error:
                self.notes.append(f"{file.name} cannot be read: {error.strerror}")

    @cached_property
    def heads(self) -> list[McapMessage]:
        """The first message of every topic, as far as ``HEAD`` messages reach; no message is read
        after those of all topics that the summary names."""
        left, seen = set(self.counts or ()), dict[str, McapMessage]()
        for _, message in zip(range(HEAD), self, strict=False):
            seen.setdefault(message.topic, message)
            if left and left <= seen.keys():
                break
        return list(seen.values())

    @cached_property
    def counts(self) -> dict[str, int] | None:
        """Messages by topic from the files' summaries; None if one was cut off before it."""
        from mcap.exceptions import McapError
        from mcap.reader import make_reader

        counts: dict[str, int] = {}
        for path in self.files:
            try:
                with path.open("rb") as file:
                    summary = make_reader(file).get_summary()
            except (McapError, ValueError, OSError, KeyError, MemoryError):
                return None
            if summary is None or summary.statistics is None:
                return None
            for number, count in summary.statistics.channel_message_counts.items():
                topic = summary.channels[number].topic
                counts[topic] = counts.get(topic, 0) + count
        return counts

    def _messages(self, path: Path, wanted: Callable[[str], bool]) -> Iterator[McapMessage]:
        from mcap.records import Channel, Message, Metadata, Schema

        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for record in self._records(path):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Metadata):
                self.facts[record.name] = record.metadata
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                if wanted(channel.topic):
                    yield _message(record, channel, schemas.get(channel.schema_id), path.name)

    def _records(self, path: Path) -> Iterator[McapRecord]:
        """Records in file order, those of chunks among them, up to the first unreadable one."""
        from mcap.exceptions import EndOfFile, InvalidMagic, McapError
        from mcap.records import Chunk, DataEnd
        from mcap.stream_reader import StreamReader

        damaged = 0
        with path.open("rb") as file:
            stream = cast(BinaryIO, _Whole(file))
            reader = StreamReader(stream, emit_chunks=True, record_size_limit=RECORD_LIMIT).records
            while True:
                try:
                    record = next(reader, None)
                except InvalidMagic:
                    raise InputError(f"{path} is not an MCAP file, whatever its name") from None
                except (McapError, EndOfFile, ValueError, MemoryError):
                    self.notes.append(f"{path.name} was cut off; all before its end is used")
                    break
                if record is None or isinstance(record, DataEnd):
                    break
                if not isinstance(record, Chunk):
                    yield record
                    continue
                inside = _unpack(record)
                damaged += inside is None
                yield from inside or []
        if damaged:
            self.notes.append(f"{damaged} damaged chunks of {path.name} were left out")


def _unpack(chunk: Chunk) -> list[McapRecord] | None:
    """The records in a chunk; None if it is damaged, at the second attempt too."""
    from mcap.exceptions import EndOfFile, McapError
    from mcap.stream_reader import CRCValidationError, breakup_chunk

    for _ in range(ATTEMPTS):
        try:
            return breakup_chunk(chunk, validate_crc=True)
        except (CRCValidationError, McapError, EndOfFile, ValueError, RuntimeError):
            continue
    return None


class _Whole:
    """Reads all or nothing: mcap takes half a record for a whole one."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def read(self, size: int = -1) -> bytes:
        at = self._file.tell()
        try:
            data = self._file.read(size)
        except OSError:  # a worn medium often gives on the second attempt what it did not at first
            self._file.seek(at)
            data = self._file.read(size)
        return data if len(data) == size else b""


def _message(record: Message, channel: Channel, schema: Schema | None, file: str) -> McapMessage:
    return McapMessage(
        channel.topic,
        channel.message_encoding,
        schema,
        record.log_time,
        record.publish_time,
        record.sequence,
        record.data,
        file,
    )
