"""ROS 1 and ROS 2 bags, read without ROS."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aquaflow.base.errors import InputError, reason_of
from aquaflow.recordings.camera_info import choose_topic

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

ROS_1_SUFFIX, ROS_2_FILE = ".bag", "metadata.yaml"
"""A bag of ROS 1 is a file, one of ROS 2 a folder with this file in it."""
ROS_2_STORAGE = frozenset({".db3", ".mcap"})
"""Suffixes of the files next to it that hold the messages."""

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
"""Messages with a picture."""
PICTURES = frozenset({RAW, COMPRESSED})
"""All of them."""

LONGEST_DELAY_NS = 10_000_000_000
"""Between a header's stamp and reception; a longer one means two clocks."""


def is_bag(path: Path) -> bool:
    """True for a ``.bag`` file, or a folder that ``ros2 bag record`` wrote."""
    if path.is_dir():
        stored = any(file.suffix in ROS_2_STORAGE for file in path.iterdir())
        return (path / ROS_2_FILE).is_file() and stored
    return path.is_file() and path.suffix.lower() == ROS_1_SUFFIX


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
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:  # of rosbags, YAML, SQLite, MCAP, and each compression
        raise InputError(
            f"cannot read the bag {path}: {reason_of(error)}; copy or record it again"
        ) from error
    try:
        yield reader
    finally:
        reader.close()


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

    try:
        return reader.deserialize(data, connection.msgtype)
    except (AnyReaderError, ValueError, IndexError, struct.error):
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
