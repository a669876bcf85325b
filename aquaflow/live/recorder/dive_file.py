"""One MCAP file that can be cut off at any byte and still replays up to the last flush."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, BinaryIO, cast

from aquaflow.recordings.telemetry_lines import sample_schema

LIBRARY = "aquaflow"
"""Who wrote the file, in its header."""
RAW_BYTES = "application/octet-stream"
"""Encoding of what a link received, as it came."""
JSON_OBJECT = b'{"type": "object"}'
"""Schema of objects that have none of their own."""


class DiveFile:
    """Appends messages; channels and schemas are written when first used."""

    def __init__(self, path: Path, chunk_bytes: int) -> None:
        """Create ``path``.

        Raises:
            OSError: it exists, or cannot be created.
        """
        from mcap.writer import CompressionType, Writer

        self.path = path
        self._file = path.open("xb", buffering=0)
        _sync_folder(path.parent)
        self._written = _Counting(self._file)
        # Pictures do not compress twice, and what is not compressed can be salvaged by hand.
        stream = cast(BinaryIO, self._written)
        self._writer: Any = Writer(stream, chunk_size=chunk_bytes, compression=CompressionType.NONE)
        self._writer.start(profile="", library=LIBRARY)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._pending_bytes = 0

    @property
    def size(self) -> int:
        """Bytes written, with those of the chunk that is not yet complete."""
        return self._written.count + self._pending_bytes

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Facts about the recording: not a message, and not in a chunk."""
        self._writer.add_metadata(name, values)

    def protobuf(self, topic: str, message: Any, arrival_ns: int, t_ns: int, number: int) -> None:
        """A message of one of foxglove's schemas."""
        if topic not in self._channels:
            from mcap_protobuf.schema import build_file_descriptor_set

            name = message.DESCRIPTOR.full_name
            if name not in self._schemas:
                data = build_file_descriptor_set(type(message)).SerializeToString()
                self._schemas[name] = self._writer.register_schema(name, "protobuf", data)
            self._open(topic, "protobuf", self._schemas[name])
        self._add(topic, message.SerializeToString(), arrival_ns, t_ns, number)

    def json(
        self, topic: str, kind: str, data: bytes, arrival_ns: int, t_ns: int, number: int = 0
    ) -> None:
        """A JSON object; ``kind`` is that of a telemetry sample, or a name of its own."""
        if topic not in self._channels:
            name = f"aquaflow.{kind}"
            if name not in self._schemas:
                schema = sample_schema(kind) if kind.islower() else JSON_OBJECT
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", schema)
            self._open(topic, "json", self._schemas[name])
        self._add(topic, data, arrival_ns, t_ns, number)

    def raw(self, topic: str, data: bytes, arrival_ns: int) -> None:
        """Bytes as they came."""
        if topic not in self._channels:
            self._open(topic, RAW_BYTES, 0)
        self._add(topic, data, arrival_ns, arrival_ns, 0)

    def flush(self) -> None:
        """Complete the chunk and bring everything to the disk."""
        self._writer.flush()
        self._pending_bytes = 0
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Write the index and close; the file replays without it too."""
        try:
            self._writer.finish()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close without another byte: the disk takes none."""
        self._file.close()

    def _open(self, topic: str, encoding: str, schema: int) -> None:
        self._channels[topic] = self._writer.register_channel(topic, encoding, schema)

    def _add(self, topic: str, data: bytes, arrival_ns: int, t_ns: int, number: int) -> None:
        before = self._written.count
        self._writer.add_message(self._channels[topic], arrival_ns, data, t_ns, number)
        complete = self._written.count > before
        self._pending_bytes = 0 if complete else self._pending_bytes + len(data)


class _Counting:
    """A raw file that writes all it is given, and knows its position without asking the system."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self.count = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        self.count += len(data)
        return len(data)

    def tell(self) -> int:
        return self.count

    def flush(self) -> None:
        """Nothing waits here."""


def _sync_folder(folder: Path) -> None:
    """A file whose folder entry is not on the disk is lost with the power."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
