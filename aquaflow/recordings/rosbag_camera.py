"""Pictures of a ROS bag as a camera."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aquaflow.base.errors import InputError, printable
from aquaflow.geometry.camera import CameraModel, guess_camera
from aquaflow.recordings.picture import (
    Stored,
    UnreadablePictureError,
    WhiteLevel,
    decode_picture,
    received_as,
    stated_white,
)
from aquaflow.recordings.picture_message import (
    CAMERA_INFO,
    camera_of_info,
    choose_topic,
    info_topic,
    is_rectified,
    raw_picture,
)
from aquaflow.recordings.rosbag import (
    COMPRESSED,
    decode,
    is_bag,
    messages_in,
    open_bag,
    origin_of,
    picture_connections,
    picture_topics,
    stamp_of,
)
from aquaflow.sources import is_asked
from aquaflow.types import Dropped, Frame

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader


class RosbagCamera:
    """One picture topic of a bag; times count from its first picture."""

    specificity = 2

    def __init__(self, path: Path, fps: float | None = None, topic: str | None = None) -> None:
        """Read the bag's index and calibration; of ``topic``, or of the one that suits best.

        Raises:
            InputError: the bag is damaged, or holds no picture (of ``topic``).
        """
        self.path = path
        with open_bag(path) as reader:
            counts = picture_topics(reader)
            if not counts:
                known = ", ".join(sorted({c.topic for c in reader.connections})) or "none"
                raise InputError(
                    f"the bag {path} holds no picture; give a bag with a camera; its topics are: "
                    f"{known}"
                )
            if topic is not None and topic not in counts:
                raise InputError(
                    f"the bag {path} has no pictures on {topic}; there are: "
                    f"{', '.join(sorted(counts))}"
                )
            self.topic = topic or choose_topic(counts.items()) or ""
            self.frame_count: int | None = counts[self.topic]
            self.origin_ns = origin_of(reader, self.topic)
            self.camera, said = _calibration(reader, self.topic)
        self._facts, self._white = {"calibration": said}, WhiteLevel()
        self._damage: list[str] = []
        if fps is not None:
            self._facts["times"] = f"--fps is not used: {path.name} has times of its own"
        if others := sorted(set(counts) - {self.topic}):
            also = f"also there: {', '.join(others)} (choose by --topic)"
            self._facts["topic"] = f"{self.topic} is used; {also}"

    def sources(self) -> dict[str, str]:
        """Sources of calibration, topic and white."""
        return self._facts | self._white.sources

    @property
    def notes(self) -> list[str]:
        """The sources, and what was left out."""
        return [*self.sources().values(), *self._damage]

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return is_bag(path)

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> RosbagCamera:
        return cls(path, fps)

    @classmethod
    def topic_of(cls, path: Path, topic: str) -> RosbagCamera:
        """Open ``topic`` of a bag; raises as the constructor."""
        return cls(path, topic=topic)

    def name_of(self, index: int) -> str:
        """The bag's name and the picture's number, ``dive.bag#12``."""
        return f"{printable(self.path.name)}#{index}"

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        """The pictures ``start, start + every, ...`` below ``stop``, in the order of reception."""
        self._damage = []
        with open_bag(self.path) as reader:
            messages = messages_in(reader, picture_connections(reader, self.topic), self._damage)
            for index, (connection, received_ns, data) in enumerate(messages):
                if stop is not None and index >= stop:
                    return
                if is_asked(index, every, start):
                    message = decode(reader, connection, data)
                    yield self._frame(index, message, received_ns, connection.msgtype)

    def close(self) -> None:
        """Nothing stays open between passes."""

    def _frame(self, index: int, message: Any, received_ns: int, kind: str) -> Frame | Dropped:
        t_ns = stamp_of(message, received_ns) - self.origin_ns
        arrival_ns = max(received_ns - self.origin_ns, t_ns)
        try:
            stored, data = _decode(message, kind)
        except UnreadablePictureError as error:
            return Dropped(index, t_ns, f"{self.name_of(index)} {error}")
        image = self._white.to_rgb(stored, lambda: stated_white(data), self._whole)
        encoded = received_as(data) if kind == COMPRESSED and stored.dtype == np.uint8 else None
        camera = self.camera or guess_camera(image.shape[1], image.shape[0])
        return Frame(index, t_ns, arrival_ns, image, camera, encoded=encoded)

    def _whole(self) -> Iterator[Stored]:
        with open_bag(self.path) as reader:
            connections = picture_connections(reader, self.topic)
            for connection, _, data in messages_in(reader, connections, []):
                with suppress(UnreadablePictureError):
                    yield _decode(decode(reader, connection, data), connection.msgtype)[0]


def _decode(message: Any, kind: str) -> tuple[Stored, bytes]:
    """The picture, and the bytes of its file."""
    if message is None:
        raise UnreadablePictureError("is damaged")
    data = bytes(message.data)
    if kind == COMPRESSED:
        return decode_picture(data), data
    shape = (message.height, message.width, message.step)
    return raw_picture(data, *shape, message.encoding, bool(message.is_bigendian)), data


def _calibration(reader: AnyReader, topic: str) -> tuple[CameraModel | None, str]:
    """Of the first CameraInfo that belongs to ``topic``, and a sentence on it."""
    infos = [connection for connection in reader.connections if connection.msgtype == CAMERA_INFO]
    name = info_topic(topic, (connection.topic for connection in infos))
    if name is None:
        beside = ", ".join(sorted({each.topic for each in infos}))
        return None, f"no CameraInfo belongs to {topic}" + (
            f"; there is {beside}" if beside else ""
        )
    fitting = [connection for connection in infos if connection.topic == name]
    rectified = is_rectified(topic)
    for connection, _, data in messages_in(reader, fitting, []):
        info = decode(reader, connection, data)
        if info is None:
            break
        camera = camera_of_info(info, rectified)
        if isinstance(camera, str):
            return None, f"{name} is not used: {camera}"
        what = "P, as its pictures are rectified" if rectified else "K and D"
        return camera, f"the calibration of {topic} is that of {name}: {what}"
    return None, f"{name} cannot be read"
