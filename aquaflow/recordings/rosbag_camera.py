"""Pictures of a ROS bag as a camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, printable
from aquaflow.geometry.camera import CameraModel, guess_camera
from aquaflow.recordings.camera_info import (
    CAMERA_INFO,
    camera_of_info,
    choose_topic,
    info_topic,
    is_rectified,
)
from aquaflow.recordings.picture import UnreadablePictureError, received_as
from aquaflow.recordings.picture_message import compressed_picture, raw_picture
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
from aquaflow.types import Dropped, EncodedPicture, Frame

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
        self._facts = [said]
        if others := sorted(set(counts) - {self.topic}):
            self._facts.append(
                f"{self.topic} is used; also there: {', '.join(others)} (choose by --topic)"
            )
        self.notes = list(self._facts)

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
        self.notes = list(self._facts)
        with open_bag(self.path) as reader:
            messages = messages_in(reader, picture_connections(reader, self.topic), self.notes)
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
            image, encoded = _picture(message, kind)
        except UnreadablePictureError as error:
            return Dropped(index, t_ns, f"{self.name_of(index)} {error}")
        camera = self.camera or guess_camera(image.shape[1], image.shape[0])
        return Frame(index, t_ns, arrival_ns, image, camera, encoded=encoded)


def _picture(message: Any, kind: str) -> tuple[npt.NDArray[np.uint8], EncodedPicture | None]:
    if message is None:
        raise UnreadablePictureError("is damaged")
    data = bytes(message.data)
    if kind == COMPRESSED:
        return compressed_picture(data), received_as(data)
    shape = (message.height, message.width, message.step)
    return raw_picture(data, *shape, message.encoding, bool(message.is_bigendian)), None


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
