"""An MCAP file of ROS 2 messages, as ``ros2 bag`` writes and plays it, and Foxglove opens it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.dive.ros.definitions import (
    MESSAGE_ENCODING,
    SCHEMA_ENCODING,
    definition,
    encode,
    require_rosbags,
)
from aquaflow.dive.ros.topics import LASTING, TYPES

LIBRARY = "aquaflow"
"""Who wrote the file, in its header."""
QOS = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: {durability}\n"
    "  deadline:\n    sec: 0\n    nsec: 0\n  lifespan:\n    sec: 0\n    nsec: 0\n"
    "  liveliness: 1\n  liveliness_lease_duration:\n    sec: 0\n    nsec: 0\n"
    "  avoid_ros_namespace_conventions: false\n"
)
"""Quality of service by ROS's numbers, as rosbag2 keeps it: reliable; durability 1 is transient
local, 2 volatile."""


class RosFile:
    """Appends messages; channels and schemas are written when first used."""

    def __init__(self, writer: Any) -> None:
        """``writer`` is one of mcap's that was started."""
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.count = 0
        """Messages so far."""

    def write(self, topic: str, t_ns: int, message: Any) -> None:
        """Append a message of ``topic``, which happened at ``t_ns``."""
        if topic not in self._channels:
            name = TYPES[topic]
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(
                    name, SCHEMA_ENCODING, definition(name)
                )
            qos = QOS.format(durability=1 if topic in LASTING else 2)
            self._channels[topic] = self._writer.register_channel(
                topic, MESSAGE_ENCODING, self._schemas[name], {"offered_qos_profiles": qos}
            )
        self._writer.add_message(self._channels[topic], t_ns, encode(message), t_ns, self.count)
        self.count += 1


@contextlib.contextmanager
def ros_file(path: Path, facts: Mapping[str, str]) -> Iterator[RosFile]:
    """A file that is there, whole, once the block ends without an exception; ``facts`` are said of
    it in a metadata record named ``aquaflow``.

    Raises:
        InputError: a library is missing, or the file cannot be written.
    """
    require_rosbags()
    if find_spec("mcap") is None:
        raise InputError("MCAP files need mcap; install it: pip install 'aquaflow[recording]'")
    from mcap.writer import CompressionType, Writer

    with atomic_write(path) as stream:
        writer: Any = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library=LIBRARY)
        writer.add_metadata(LIBRARY, dict(facts))
        yield RosFile(writer)
        writer.finish()
