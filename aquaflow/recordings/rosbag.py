"""ROS 1 and ROS 2 bags, read without ROS."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from aquaflow.base.errors import InputError, reason_of
from aquaflow.recordings.picture_message import choose_topic

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

ROS_1_SUFFIX, ROS_2_FILE = ".bag", "metadata.yaml"
"""A bag of ROS 1 is a file, one of ROS 2 a folder with this file in it."""
ROS_2_STORAGE = (".db3", ".db3.zstd", ".mcap", ".mcap.zstd")
"""Endings of the files next to it that hold the messages."""
DATABASES = (".db3", ".db3.zstd")
"""Of them those that are bags without that file too: where recording was cut off, or alone."""
ZSTD, ZSTD_MAGIC = ".zstd", b"\x28\xb5\x2f\xfd"
"""Ending of a compressed file, and how compressed messages begin (RFC 8878)."""

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
"""Messages with a picture."""
PICTURES = frozenset({RAW, COMPRESSED})
"""All of them."""

LONGEST_DELAY_NS = 10_000_000_000
"""Between a header's stamp and reception; a longer one means two clocks."""


def is_bag(path: Path) -> bool:
    """True for a ``.bag`` or ``.db3`` file, or a folder that ``ros2 bag record`` wrote."""
    return bool(_files_of(path))


def _files_of(path: Path) -> list[Path]:
    """What rosbags opens of a bag, in order; nothing of what is none."""
    if not path.is_dir():
        known = path.is_file() and path.name.lower().endswith((ROS_1_SUFFIX, *DATABASES))
        return [path] if known else []
    names = sorted(file.name for file in path.iterdir())
    if (path / ROS_2_FILE).is_file():
        return [path] if any(name.endswith(ROS_2_STORAGE) for name in names) else []
    return [path / name for name in names if name.endswith(DATABASES)]


@contextmanager
def open_bag(path: Path) -> Iterator[AnyReader]:
    """The bag, open.

    Raises:
        InputError: it is damaged, or the extra ``recording`` is missing.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(
            f"ROS bags need {error.name}; install it with pip install 'aquaflow[recording]'"
        ) from error
    with ExitStack() as stack:
        try:
            files = [_unpack(file, stack) for file in _files_of(path)]
            reader = AnyReader(files, default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            reader.open()
        except Exception as error:  # of rosbags, YAML, SQLite, MCAP, and each compression
            raise InputError(
                f"cannot read the bag {path}: {reason_of(error)}; copy or record it again"
            ) from error
        stack.callback(reader.close)
        yield reader


def _unpack(file: Path, stack: ExitStack) -> Path:
    """The file, or what it was before it was compressed, for as long as ``stack`` lasts."""
    if not file.name.endswith(ZSTD):
        return file
    from zstandard import ZstdDecompressor

    plain = Path(stack.enter_context(TemporaryDirectory())) / file.name.removesuffix(ZSTD)
    with file.open("rb") as packed, plain.open("wb") as unpacked:
        ZstdDecompressor().copy_stream(packed, unpacked)
    return plain


def messages_in(
    reader: AnyReader, connections: list[Connection], notes: list[str]
) -> Iterator[tuple[Connection, int, bytes]]:
    """Connection, time of reception and bytes, up to the first place that cannot be read.

    That there was one is added to ``notes``.
    """
    messages = reader.messages(connections) if connections else iter(())
    while True:
        try:
            message = next(messages, None)
        except Exception:  # SQLite, MCAP and each compression have errors of their own
            notes.append("the bag is damaged; all before the damage is used")
            return
        if message is None:
            return
        yield message


def picture_topics(reader: AnyReader) -> dict[str, int]:
    """Messages of the topics that hold pictures."""
    counts: dict[str, int] = {}
    for each in reader.connections:
        if each.msgtype in PICTURES and each.msgcount > 0:
            counts[each.topic] = counts.get(each.topic, 0) + each.msgcount
    return counts


def picture_connections(reader: AnyReader, topic: str | None = None) -> list[Connection]:
    """Those of a picture topic; None: of the one that suits best."""
    chosen = topic or choose_topic(picture_topics(reader).items())
    return [c for c in reader.connections if c.msgtype in PICTURES and c.topic == chosen]


def decode(reader: AnyReader, connection: Connection, data: bytes) -> Any | None:
    """The message with its fields as attributes; None if it is damaged."""
    from rosbags.highlevel import AnyReaderError
    from zstandard import ZstdDecompressor, ZstdError

    try:
        if data[:4] == ZSTD_MAGIC:  # in a database without the file that says so
            data = ZstdDecompressor().decompress(data)
        return reader.deserialize(data, connection.msgtype)
    except (AnyReaderError, ZstdError, ValueError, IndexError, struct.error):
        return None


def stamp_of(message: Any, received_ns: int) -> int:
    """The header's time, ns since 1970; that of reception where the header has another clock's."""
    header = getattr(message, "header", None)
    if header is None:
        return received_ns
    stamp_ns = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
    return stamp_ns if abs(stamp_ns - received_ns) <= LONGEST_DELAY_NS else received_ns


def origin_of(reader: AnyReader, topic: str | None = None) -> int:
    """Time of the first picture; that of the bag's first message where it holds no picture."""
    pictures = picture_connections(reader, topic)
    for connection, received_ns, data in messages_in(reader, pictures, []):
        return stamp_of(decode(reader, connection, data), received_ns)
    return int(reader.start_time)
