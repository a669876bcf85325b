"""Pictures of a ROS bag as a camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, printable
from aquaflow.geometry.camera import CameraModel, DistortionModel, guess_camera
from aquaflow.recordings.picture import UnreadablePictureError, received_as
from aquaflow.recordings.picture_message import compressed_picture, raw_picture
from aquaflow.recordings.rosbag import (
    COMPRESSED,
    PICTURES,
    decode,
    is_bag,
    messages_in,
    open_bag,
    origin_of,
    picture_connections,
    stamp_of,
)
from aquaflow.sources import is_asked
from aquaflow.types import Dropped, EncodedPicture, Frame

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
"""Message with a camera's calibration."""

DISTORTIONS: dict[str, DistortionModel] = {
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""ROS's distortion models, and the names here of those that are known."""


class RosbagCamera:
    """The first picture topic by name; times count from its first picture."""

    specificity = 2

    def __init__(self, path: Path, fps: float | None = None) -> None:
        """Read the bag's index and calibration.

        Raises:
            InputError: the bag is damaged or holds no picture.
        """
        self.path = path
        self.notes: list[str] = []
        with open_bag(path) as reader:
            pictures = picture_connections(reader)
            if not pictures:
                raise InputError(f"the bag {path} holds no picture; give a bag with a camera")
            self.topic = pictures[0].topic
            self.frame_count: int | None = sum(connection.msgcount for connection in pictures)
            self.origin_ns = origin_of(reader)
            self.camera = _calibration(reader, self.topic)
            others = {c.topic for c in reader.connections if c.msgtype in PICTURES} - {self.topic}
        self._other_topics = sorted(others)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return is_bag(path)

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> RosbagCamera:
        return cls(path, fps)

    def name_of(self, index: int) -> str:
        """The bag's name and the picture's number, ``dive.bag#12``."""
        return f"{printable(self.path.name)}#{index}"

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        """The pictures ``start, start + every, ...`` below ``stop``, in the order of reception."""
        self.notes = []
        if self._other_topics:
            self.notes.append(f"{self.topic} is used; also there: {', '.join(self._other_topics)}")
        with open_bag(self.path) as reader:
            messages = messages_in(reader, picture_connections(reader), self.notes)
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
    return raw_picture(data, message.height, message.width, message.step, message.encoding), None


def _calibration(reader: AnyReader, topic: str) -> CameraModel | None:
    """The first CameraInfo with the namespace of ``topic``; ROS counts pixel centres as integers,
    we do not."""
    base = topic.removesuffix("/compressed").rpartition("/")[0]
    infos = [connection for connection in reader.connections if connection.msgtype == CAMERA_INFO]
    siblings = [connection for connection in infos if connection.topic.startswith(base)]
    for connection, _, data in messages_in(reader, siblings, []):
        info = decode(reader, connection, data)
        if info is None:
            return None
        fields = {name.lower(): value for name, value in vars(info).items()}
        model = DISTORTIONS.get(info.distortion_model)
        k, d = np.asarray(fields["k"], np.float64), tuple(float(v) for v in fields["d"])
        if k[0] <= 0.0 or (model is None and any(d)):
            return None
        return CameraModel(
            int(info.width), int(info.height), k[0], k[4], k[2] + 0.5, k[5] + 0.5,
            model or "none", d if model else (),
        )  # fmt: skip
    return None
