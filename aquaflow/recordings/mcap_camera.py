"""A camera of an MCAP recording: ours, or any with foxglove's or ROS's picture messages."""

from __future__ import annotations

import base64
import binascii
import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError, printable
from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.camera import (
    CameraModel,
    camera_of_values,
    guess_camera,
    has_unmeasured_port,
)
from aquaflow.recordings.h264 import decode_units, is_key
from aquaflow.recordings.mcap_messages import McapMessage, McapMessages, mcap_files
from aquaflow.recordings.picture import (
    Stored,
    UnreadablePictureError,
    WhiteLevel,
    decode_picture,
    received_as,
    stated_white,
    to_rgb,
)
from aquaflow.recordings.picture_message import (
    camera_of_info,
    choose_topic,
    info_topic,
    is_rectified,
    raw_picture,
)
from aquaflow.recordings.rosbag import stamp_of
from aquaflow.sources import is_asked
from aquaflow.types import Dropped, EncodedPicture, Frame

if TYPE_CHECKING:
    from mcap.records import Schema

COMPRESSED, RAW, VIDEO = "CompressedImage", "RawImage", "CompressedVideo"
"""Foxglove's messages."""
RAW_NAMES = frozenset({RAW, "Image"})
"""Foxglove's and ROS's messages of pictures that are not compressed."""
ROS_ENCODINGS = ("ros1", "cdr")
"""Of messages, in ROS 1 and ROS 2."""
OURS = "aquaflow"
"""Name of the metadata that AquaFlow's recorder writes."""
MOUNTING = "mounting"
"""Key of a camera's metadata: its mounting in the vehicle as JSON."""


def picture_kind(message: McapMessage) -> str | None:
    """CompressedImage, RawImage or CompressedVideo; None if it is no picture."""
    name = "" if message.schema is None else message.schema.name.replace(".", "/").split("/")[-1]
    if name in RAW_NAMES:
        return RAW
    return name if name in (COMPRESSED, VIDEO) else None


@dataclass(frozen=True)
class _Place:
    """Metadata that the recorder wrote with a picture."""

    index: int
    t_ns: int
    arrival_ns: int
    exposure_s: float | None = None
    gain: float | None = None
    mask: npt.NDArray[np.bool_] | None = None


class McapCamera:
    """Pictures of one topic; times count from the first of them."""

    specificity = 2

    def __init__(self, path: Path, camera: str | None = None, topic: str | None = None) -> None:
        """Look for the first picture, of ``camera`` or of the first camera that there is.

        Raises:
            InputError: the files hold no picture, or the extra ``recording`` is missing.
        """
        self.path = path
        self._messages = McapMessages(mcap_files(path))
        self._payloads = Payloads()
        if camera is None and topic is None:
            topic = self._choose_topic()
        first, self.origin_ns = self._first_picture(camera, topic)
        self.topic = first.topic
        self._base = first.topic.rpartition("/")[0]
        self._ours = OURS in self._messages.facts
        self._facts: dict[str, str] = {}
        self._white = WhiteLevel()
        self._stated = self._calibration()
        """As every frame carried it, be it only a guess."""
        known = self._stated is not None and self._stated.calibrated
        self.camera: CameraModel | None = self._stated if known else None
        self.frame_count: int | None = self._count(self._messages.counts)
        if others := self._other_topics():
            also = f"also there: {', '.join(others)} (choose by --topic)"
            self._facts["topic"] = f"{self.topic} is used; {also}"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return bool(mcap_files(path)) and not (path / "metadata.yaml").is_file()

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> McapCamera:
        camera = cls(path)
        if fps is not None:
            camera._facts["times"] = f"--fps is not used: {path.name} has times of its own"
        return camera

    def sources(self) -> dict[str, str]:
        """Sources of calibration, topic and white."""
        return self._facts | self._white.sources

    @property
    def notes(self) -> list[str]:
        """The sources, and what was left out."""
        return [*self.sources().values(), *self._messages.notes]

    @classmethod
    def topic_of(cls, path: Path, topic: str) -> McapCamera:
        """Open ``topic`` of a recording; raises InputError if it has no pictures there."""
        return cls(path, topic=topic)

    def name_of(self, index: int) -> str:
        """The recording's name and the picture's number, ``dive.mcap#12``."""
        return f"{printable(self.path.name)}#{index}"

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        """The pictures whose index is ``start, start + every, ...`` below ``stop``.

        Raises:
            InputError: none could be read, though there was one when the recording was opened.
        """
        any_read = False
        pictures = self._video() if self._kind == VIDEO else self._pictures(every, start)
        for frame in pictures:
            any_read = True
            if stop is not None and frame.index >= stop:
                break
            if is_asked(frame.index, every, start):
                yield frame
        if not any_read:
            raise InputError(f"{self.path} holds no picture any more: {'; '.join(self.notes)}")

    def close(self) -> None:
        """Nothing stays open between passes."""

    def stated_mounting(self) -> MountingConfig | None:
        """Stated mounting of the camera in the vehicle, as the recorder knew it.

        Raises:
            InputError: the statement in the file is damaged.
        """
        facts = self._messages.facts.get(f"camera:{self._base.strip('/')}", {})
        if not self._ours or MOUNTING not in facts:
            return None
        try:
            return MountingConfig.model_validate_json(facts[MOUNTING])
        except ValueError:
            raise InputError(
                f"the mounting of the camera in {self.path.name} is damaged; give fusion.camera"
            ) from None

    def _choose_topic(self) -> str | None:
        """The picture topic that suits best, where there are several and none is ours."""
        heads = []
        for each in self._messages.heads:
            if OURS in self._messages.facts:
                return None
            heads.append(each)
        found = [each.topic for each in heads if picture_kind(each) is not None]
        if len(found) < 2:
            return None
        counts = self._messages.counts or Counter(each.topic for each in heads)
        return choose_topic((topic, counts.get(topic, 0)) for topic in found)

    def _first_picture(self, camera: str | None, topic: str | None) -> tuple[McapMessage, int]:
        """The first picture, and when it or a missing one before it was taken."""
        missing: dict[str, int] = {}
        for message in self._messages:
            base, _, name = message.topic.rpartition("/")
            kind = picture_kind(message)
            if name == "dropped":
                missing.setdefault(base, message.publish_ns)
            elif (
                kind is not None
                and name != "mask"
                and camera in (None, base.strip("/"))
                and topic in (None, message.topic)
            ):
                self._kind = kind
                taken_ns = message.publish_ns
                with suppress(UnreadablePayloadError):
                    taken_ns = _taken_ns(message, self._payloads.decode(message))
                return message, missing.get(base, taken_ns)
        which = "" if camera is None else f" of camera '{camera}'"
        which += "" if topic is None else f" on {topic}"
        known = ", ".join(sorted(message.topic for message in self._messages.heads)) or "none"
        raise InputError(
            f"{self.path} holds no picture{which}; give a recording with a camera; its topics are: "
            f"{known}"
        )

    def _calibration(self) -> CameraModel | None:
        facts = self._messages.facts.get(f"camera:{self._base.strip('/')}")
        if facts is None:
            return None if self._ours else self._camera_info()
        try:
            fields = json.loads(facts["model"])
            if has_unmeasured_port(fields):
                self._facts["calibration"] = (
                    f"the calibration in {self.path.name} names a {fields['port']['kind']} port "
                    "without its measures, which was left out; give --calib with them"
                )
            return camera_of_values(fields)
        except (KeyError, TypeError, ValueError, RecursionError):
            said = f"the calibration in {self.path.name} is damaged and was left out"
            self._facts["calibration"] = said
            return None

    def _camera_info(self) -> CameraModel | None:
        """Of the CameraInfo of ROS that belongs to the topic."""
        found: dict[str, McapMessage] = {}
        for message in self._messages.heads:
            name = "" if message.schema is None else message.schema.name.replace("/msg/", "/")
            if name == "sensor_msgs/CameraInfo":
                found.setdefault(message.topic, message)
        topic = info_topic(self.topic, found)
        if topic is None:
            return None
        try:
            camera = camera_of_info(self._payloads.decode(found[topic]), is_rectified(self.topic))
        except (UnreadablePayloadError, AttributeError, KeyError):
            camera = "it cannot be read"
        if isinstance(camera, str):
            self._facts["calibration"] = f"{topic} is not used: {camera}"
            return None
        self._facts["calibration"] = f"the calibration of {self.topic} is that of {topic}"
        return camera

    def _count(self, counts: dict[str, int] | None) -> int | None:
        if counts is None:
            return None
        return counts.get(self.topic, 0) + counts.get(f"{self._base}/dropped", 0)

    def _placed_messages(self) -> Iterator[tuple[_Place, McapMessage | str]]:
        """Pictures with what belongs to them; a sentence instead of one that is missing."""
        extra: dict[str, Any] = {}
        mask: npt.NDArray[np.bool_] | None = None
        topics = {self.topic: "picture"}
        if self._ours:  # elsewhere, topics of these names hold what their makers mean by them
            topics |= {f"{self._base}/{kind}": kind for kind in ("dropped", "exposure", "mask")}
        for count, message in _number_messages(self._messages.of(topics.__contains__), self.topic):
            kind = topics[message.topic]
            if kind == "mask":
                data = self._payloads.decode(message).data
                mask = to_rgb(decode_picture(data), 1)[..., 0] > 0
            elif kind == "exposure":
                extra = json.loads(message.data)
            else:
                place = _Place(
                    message.number if self._ours else count,
                    message.publish_ns - self.origin_ns,
                    message.log_ns - self.origin_ns,
                    mask=mask,
                    **extra if kind == "picture" else {},
                )
                extra = {} if kind == "picture" else extra
                gone = json.loads(message.data)["reason"] if kind == "dropped" else None
                yield place, message if gone is None else gone

    def _pictures(self, every: int, start: int) -> Iterator[Frame | Dropped]:
        for place, found in self._placed_messages():
            if not is_asked(place.index, every, start):
                continue
            if isinstance(found, str):
                yield Dropped(place.index, place.t_ns, found)
                continue
            try:
                fields = self._payloads.decode(found)
                stored, data = self._decode(fields)
            except (UnreadablePictureError, UnreadablePayloadError) as error:
                yield Dropped(place.index, place.t_ns, f"{self.name_of(place.index)} {error}")
                continue
            image = self._white.to_rgb(stored, partial(stated_white, data), self._whole)
            plain = self._kind == COMPRESSED and stored.dtype == np.uint8
            taken = replace(place, t_ns=_taken_ns(found, fields) - self.origin_ns)
            yield self._frame(taken, image, received_as(data) if plain else None)

    def _decode(self, fields: Any) -> tuple[Stored, bytes]:
        """The picture, and the bytes of its file."""
        data = bytes(fields.data)
        if self._kind == COMPRESSED:
            return decode_picture(data), data
        shape = (fields.height, fields.width, fields.step)
        big_endian = bool(getattr(fields, "is_bigendian", False))  # of ROS; foxglove's never are
        return raw_picture(data, *shape, fields.encoding, big_endian), data

    def _whole(self) -> Iterator[Stored]:
        for message in McapMessages(self._messages.files).of(self.topic.__eq__):
            with suppress(UnreadablePictureError, UnreadablePayloadError):
                yield self._decode(self._payloads.decode(message))[0]

    def _other_topics(self) -> list[str]:
        heads = (each for each in self._messages.heads if picture_kind(each) is not None)
        masks = f"{self._base}/mask"
        return sorted({each.topic for each in heads} - {self.topic, masks})

    def _video(self) -> Iterator[Frame | Dropped]:
        gone: list[Dropped] = []

        def units() -> Iterator[tuple[tuple[_Place, EncodedPicture], bytes]]:
            for place, found in self._placed_messages():
                if isinstance(found, str):
                    gone.append(Dropped(place.index, place.t_ns, found))
                    continue
                data = bytes(self._payloads.decode(found).data)
                yield (place, EncodedPicture("h264", data, is_key(data))), data

        for (place, encoded), image in decode_units(units()):
            while gone and gone[0].index < place.index:
                yield gone.pop(0)
            if image is None:
                reason = f"{self.name_of(place.index)} cannot be decoded"
                yield Dropped(place.index, place.t_ns, reason)
            else:
                yield self._frame(place, image, encoded)
        yield from gone

    def _frame(
        self,
        place: _Place,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
        encoded: EncodedPicture | None,
    ) -> Frame:
        height, width = image.shape[:2]
        camera = self._stated or guess_camera(width, height)
        frame = Frame(place.index, place.t_ns, place.arrival_ns, image, camera, encoded=encoded)
        return replace(frame, exposure_s=place.exposure_s, gain=place.gain, mask=place.mask)


def _taken_ns(message: McapMessage, fields: Any) -> int:
    """When the picture was taken: by the header of ROS, else when the message was published."""
    in_ros = message.encoding in ROS_ENCODINGS
    return stamp_of(fields, message.log_ns) if in_ros else message.publish_ns


def _number_messages(
    messages: Iterator[McapMessage], topic: str
) -> Iterator[tuple[int, McapMessage]]:
    """Messages with the number of messages of ``topic`` before them."""
    count = 0
    for message in messages:
        yield count, message
        count += message.topic == topic


# --------------------------------------------------------------------------------------------------
# Payloads of MCAP messages as objects with named fields: protobuf, JSON, and both of ROS.

Decode = Callable[[bytes], Any]


class UnreadablePayloadError(Exception):
    """A message that cannot be decoded; the text is a reason that follows its topic."""


class Payloads:
    """Decodes messages; what a schema needs is built once."""

    def __init__(self) -> None:
        self._decoders: dict[tuple[str, str, bytes], Decode] = {}

    def decode(self, message: McapMessage) -> Any:
        """The message's fields as attributes.

        Raises:
            UnreadablePayloadError: unknown encoding, or damaged data.
        """
        schema = message.schema
        if schema is None:
            raise UnreadablePayloadError("has no schema")
        key = (message.encoding, schema.name, schema.data)
        try:
            if key not in self._decoders:
                self._decoders[key] = _decoder(message.encoding, schema)
            return self._decoders[key](message.data)
        except UnreadablePayloadError:
            raise
        except Exception as error:  # each library has errors of its own
            raise UnreadablePayloadError(f"cannot be decoded as {schema.name}") from error


def _decoder(encoding: str, schema: Schema) -> Decode:
    if encoding == "protobuf":
        from mcap_protobuf.decoder import DecoderFactory

        decode = DecoderFactory().decoder_for(encoding, schema)
        if decode is not None:
            return decode
    if encoding == "json":
        return _from_json
    if encoding in ROS_ENCODINGS:
        return _ros(encoding, schema)
    raise UnreadablePayloadError(f"is encoded as '{encoding}'")


def _from_json(data: bytes) -> Any:
    """foxglove's JSON has bytes in base64."""
    fields = json.loads(data)
    if isinstance(fields.get("data"), str):
        try:
            fields["data"] = base64.b64decode(fields["data"], validate=True)
        except binascii.Error as error:
            raise UnreadablePayloadError("holds data that are not base64") from error
    return SimpleNamespace(**fields)


def _ros(encoding: str, schema: Schema) -> Decode:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    package, _, name = schema.name.replace("/msg/", "/").partition("/")
    typename = f"{package}/msg/{name}"
    if typename not in store.fielddefs:
        store.register(get_types_from_msg(schema.data.decode(), typename))
    read = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return lambda data: read(data, typename)
