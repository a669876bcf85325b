"""Bags of ROS and MCAP files: storage, compression, encodings, topics, CameraInfo."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from aquaflow.geometry.camera import CameraModel
from tests.recordings.inputs import Dive, Made, Picture, made, row
from tests.recordings.inputs.films import film

BEGAN_NS = 1_700_000_000_000_000_000
LATE_NS = 20_000_000
"""Between a picture's stamp and its reception."""
TOPIC = "/cam/image_raw"


class Messages:
    """Messages of either generation of ROS."""

    def __init__(self, ros1: bool) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)

    def make(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def header(self, t_ns: int) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", t_ns // 10**9, t_ns % 10**9)
        values = (0, stamp, "f") if self.ros1 else (stamp, "f")
        return self.make("std_msgs/msg/Header", *values)

    def vector(self, *xyz: float) -> Any:
        return self.make("geometry_msgs/msg/Vector3", *xyz)

    def serialized(self, message: Any) -> bytes:
        name = message.__msgtype__
        write = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        return bytes(write(message, name))

    def image(self, t_ns: int, encoding: str, pixels: npt.NDArray[Any]) -> Any:
        """sensor_msgs/Image."""
        height = len(pixels) * 2 // 3 if encoding in ("nv12", "nv21") else len(pixels)
        data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
        width, step = pixels.shape[1], len(data) // len(pixels)
        return self.make(
            "sensor_msgs/msg/Image", self.header(t_ns), height, width, encoding, 0, step, data
        )

    def compressed(self, t_ns: int, picture: Picture, suffix: str = ".jpg") -> Any:
        """sensor_msgs/CompressedImage."""
        fine = [cv2.IMWRITE_JPEG_QUALITY, 98] if suffix == ".jpg" else []
        _, data = cv2.imencode(suffix, picture[..., ::-1], fine)
        name = "sensor_msgs/msg/CompressedImage"
        return self.make(name, self.header(t_ns), suffix[1:], data.ravel())

    def camera_info(self, camera: CameraModel, **changes: Any) -> Any:
        """sensor_msgs/CameraInfo of a camera, whose D and P may be stated apart."""
        k = [camera.fx, 0, camera.cx - 0.5, 0, camera.fy, camera.cy - 0.5, 0, 0, 1]
        p = [*k[:3], 0, *k[3:6], 0, *k[6:], 0]
        values = {
            "size": (camera.height, camera.width), "model": "plumb_bob", "d": [0.0] * 5, "k": k,
            "p": p, "binning": (0, 0), "roi": (0, 0, 0, 0),
        } | changes  # fmt: skip
        roi = self.make("sensor_msgs/msg/RegionOfInterest", *values["roi"], False)
        return self.make(
            "sensor_msgs/msg/CameraInfo", self.header(BEGAN_NS), *values["size"], values["model"],
            *(np.array(values[name], float) for name in ("d", "k")), np.eye(3).ravel(),
            np.array(values["p"], float), *values["binning"], roi,
        )  # fmt: skip


Event = tuple[str, int, Any]
"""Topic, ns after the first picture, message."""


def pictures_of(
    messages: Messages, dive: Dive, encoding: str = "rgb8", topic: str = TOPIC,
    coded: Callable[[Picture], npt.NDArray[Any]] = lambda picture: picture, start_ns: int = 0,
) -> list[Event]:  # fmt: skip
    """The dive's pictures as messages."""
    times = [start_ns + round(t * 1e9) for t in dive.times_s]
    if encoding in (".jpg", ".png"):
        return [
            (topic, t_ns, messages.compressed(BEGAN_NS + t_ns, each, encoding))
            for t_ns, each in zip(times, dive.pictures, strict=True)
        ]
    return [
        (topic, t_ns, messages.image(BEGAN_NS + t_ns, encoding, coded(each)))
        for t_ns, each in zip(times, dive.pictures, strict=True)
    ]


def write_bag(path: Path, messages: Messages, events: Sequence[Event], **options: Any) -> Path:
    """A bag of ROS 1 or 2 with messages in the order of their times."""
    if messages.ros1:
        opened: Any = Writer1(path)
        if options:
            opened.set_compression(options["compression"])
    else:
        plugin = options.get("storage", StoragePlugin.SQLITE3)
        opened = Writer2(path, version=8, storage_plugin=plugin)
        if "mode" in options:
            opened.set_compression(options["mode"], CompressionFormat.ZSTD)
    with opened as writer:
        connections: dict[str, Any] = {}
        for topic, t_ns, message in sorted(events, key=lambda event: event[1]):
            if topic not in connections:
                kind = message.__msgtype__
                connections[topic] = writer.add_connection(topic, kind, typestore=messages.store)
            data = messages.serialized(message)
            writer.write(connections[topic], BEGAN_NS + t_ns + LATE_NS, data)
    return path


def _storage(name: str, ros1: bool, said: str = "", single: str = "", **options: Any) -> None:
    @row(f"bag {name}", near=0.0, says=said or "the calibration of /cam/image_raw is that of")
    def _made(dive: Dive, folder: Path) -> Made:
        messages = Messages(ros1)
        info = ("/cam/camera_info", 0, messages.camera_info(dive.camera))
        events = [info, *pictures_of(messages, dive)]
        path = write_bag(folder / ("a.bag" if ros1 else "bag"), messages, events, **options)
        if single:
            (path / "metadata.yaml").unlink()
            (file,) = path.iterdir()
            path = file.rename(folder / f"dive{single}")
        return made(dive, path, camera=dive.camera)


_storage("ROS 1", True)
_storage("ROS 1, bz2", True, compression=Writer1.CompressionFormat.BZ2)
_storage("ROS 1, lz4", True, compression=Writer1.CompressionFormat.LZ4)
_storage("ROS 2, db3", False)
_storage("ROS 2, MCAP", False, storage=StoragePlugin.MCAP)
_storage("ROS 2, db3.zstd", False, mode=CompressionMode.FILE)
_storage("ROS 2, db3, messages compressed", False, mode=CompressionMode.MESSAGE)
_storage("ROS 2, a single .db3", False, single=".db3")
_storage("ROS 2, a single .db3.zstd", False, single=".db3.zstd", mode=CompressionMode.FILE)
_storage("ROS 2, a single .mcap", False, single=".mcap", storage=StoragePlugin.MCAP)


def _yuv(layout: str) -> Callable[[Picture], npt.NDArray[Any]]:
    return lambda each: cv2.cvtColor(each, getattr(cv2, f"COLOR_RGB2YUV_{layout}"))


def _planes(each: Picture) -> npt.NDArray[Any]:
    planes = cv2.cvtColor(each, cv2.COLOR_RGB2YUV_I420)
    height = len(each)
    u, v = planes[height:].reshape(2, height // 2, -1)
    return np.concatenate([planes[:height], np.stack([u, v], 2).reshape(height // 2, -1)])


def _mosaic(each: Picture) -> npt.NDArray[Any]:
    pattern = np.empty(each.shape[:2], each.dtype)
    for k, channel in enumerate((0, 1, 1, 2)):
        pattern[k // 2 :: 2, k % 2 :: 2] = each[k // 2 :: 2, k % 2 :: 2, channel]
    return pattern


def _sixteen(each: Picture) -> npt.NDArray[Any]:
    return each.astype("<u2") * 256 + 128


ENCODINGS: list[tuple[str, float, Callable[[Picture], npt.NDArray[Any]]]] = [
    ("bgr8", 0.0, lambda each: each[..., ::-1]),
    ("rgba8", 0.0, lambda each: np.dstack([each, each[..., :1]])),
    ("bgra8", 0.0, lambda each: np.dstack([each[..., ::-1], each[..., :1]])),
    ("8UC3", 0.0, lambda each: each[..., ::-1]),
    ("rgb16", 0.0, _sixteen),
    ("bgr16", 0.0, lambda each: _sixteen(each[..., ::-1])),
    ("yuv422", 3.0, _yuv("UYVY")),
    ("uyvy", 3.0, _yuv("UYVY")),
    ("yuv422_yuy2", 3.0, _yuv("YUY2")),
    ("nv12", 3.0, _planes),
    ("bayer_rggb8", 6.0, _mosaic),
    (".jpg", 2.0, lambda each: each),
    (".png", 0.0, lambda each: each),
]


def _encoding(name: str, near: float, coded: Callable[[Picture], npt.NDArray[Any]]) -> None:
    @row(f"bag {'compressed ' * name.startswith('.')}{name}", near=near)
    def _made(dive: Dive, folder: Path) -> Made:
        messages = Messages(ros1=False)
        topic = TOPIC + "/compressed" * name.startswith(".")
        events = pictures_of(messages, dive, name, topic, coded)
        path = write_bag(folder / "bag", messages, events)
        if not name.startswith("bayer"):
            return made(dive, path)
        mosaics = [coded(each) for each in dive.pictures]
        plain = [np.asarray(cv2.cvtColor(each, cv2.COLOR_BayerBG2RGB)) for each in mosaics]
        return made(dive, path, plain=plain)


for _each in ENCODINGS:
    _encoding(*_each)


def _grey(encoding: str, said: str, shift: int) -> None:
    @row(f"bag {encoding}{' 12 bits' * (shift == 4)}", near=0.0, says=said)
    def _made(dive: Dive, folder: Path) -> Made:
        messages = Messages(ros1=False)
        grey = [np.repeat(each[..., 1:2], 3, axis=2) for each in dive.pictures]
        grey[0] = grey[0] // 17  # fits 12 bits, and must not decide for the others

        def coded(each: Picture) -> npt.NDArray[Any]:
            if not shift:
                return each[..., 0]
            return (each[..., 0].astype("<u2") << shift) + (1 << (shift - 1))

        changed = Dive(grey, dive.camera, dive.truth)
        events = pictures_of(messages, changed, encoding, TOPIC, coded)
        return made(dive, write_bag(folder / "bag", messages, events), pictures=grey)


_grey("mono8", "", 0)
_grey("mono16", "white is assumed to be 65535", 8)
_grey("16UC1", "white is assumed to be 4095", 4)


def _info(name: str, *, topic: str = TOPIC, said: str = "", **changes: Any) -> None:
    """CameraInfo whose K is not the camera of the pictures."""

    @row(f"bag CameraInfo {name}", near=0.0, says=said)
    def _made(dive: Dive, folder: Path) -> Made:
        messages = Messages(ros1=False)
        c = dive.camera
        if name == "of a part of the sensor, binned":
            k = [2 * c.fx, 0, 2 * c.cx + 39.5, 0, 2 * c.fy, 2 * c.cy + 19.5, 0, 0, 1]
            changes.update(k=k, size=(480, 640), roi=(40, 20, 2 * c.height, 2 * c.width))
            changes.update(roi=(40, 20, 2 * c.height, 2 * c.width), binning=(2, 2))
        elif name == "of a rectified topic":
            k = [150.0, 0, 70.0, 0, 150.0, 50.0, 0, 0, 1]
            changes.update(k=k, d=[-0.3, 0.1, 0.0, 0.0, 0.0])
        info = messages.camera_info(c, **changes)
        events = [("/cam/camera_info", 0, info), *pictures_of(messages, dive, topic=topic)]
        return made(dive, write_bag(folder / "bag", messages, events), camera=c)


_info("of a rectified topic", topic="/cam/image_rect_color", said="P, as its pictures are rect")
_info("of a part of the sensor, binned", said="K and D")


@row("bag CameraInfo that was never calibrated", near=0.0, says="it was never calibrated")
def _never(dive: Dive, folder: Path) -> Made:
    messages = Messages(ros1=False)
    info = messages.camera_info(dive.camera, k=np.zeros(9), p=np.zeros(12))
    events = [("/cam/camera_info", 0, info), *pictures_of(messages, dive)]
    return made(dive, write_bag(folder / "bag", messages, events))


@row("bag CameraInfo of two cameras of like names", near=0.0, says="that of /cam1/camera_info")
def _two_cameras(dive: Dive, folder: Path) -> Made:
    messages = Messages(ros1=False)
    other = CameraModel(160, 120, 90.0, 90.0, 80.0, 60.0)
    events = [
        ("/cam1_down/camera_info", 0, messages.camera_info(other)),
        ("/cam1/camera_info", 0, messages.camera_info(dive.camera)),
        *pictures_of(messages, dive, topic="/cam1/image_raw"),
        *pictures_of(messages, dive, topic="/cam1_down/image_raw")[:3],
    ]
    return made(dive, write_bag(folder / "bag", messages, events), camera=dive.camera)


def _with_depth(dive: Dive) -> tuple[Messages, list[Event]]:
    messages = Messages(ros1=False)
    depth = [
        ("/camera/aligned_depth/image", t_ns + 1, messages.image(BEGAN_NS + t_ns, "16UC1", wide))
        for t_ns in (0, 10**8, 2 * 10**8)
        if (wide := np.full((120, 160), 900, "<u2")) is not None
    ]
    return messages, [*depth, *pictures_of(messages, dive, topic="/camera/color/image_raw")]


@row("bag with depth before colour", near=0.0, says="/camera/color/image_raw is used; also there")
def _depth(dive: Dive, folder: Path) -> Made:
    return made(dive, write_bag(folder / "bag", *_with_depth(dive)))


@row("bag with --topic", near=0.0)
def _topic(dive: Dive, folder: Path) -> Made:
    messages, events = _with_depth(dive)
    events += [(topic + "/more", t, each) for topic, t, each in events if "color" in topic]
    path = write_bag(folder / "bag", messages, events)
    return made(dive, path, topic="/camera/color/image_raw")


@row("bag with a --topic that is not there", refuses="no pictures on /cam; there are: /camera/al")
def _wrong_topic(dive: Dive, folder: Path) -> Made:
    return made(dive, write_bag(folder / "bag", *_with_depth(dive)), topic="/cam")


@row("bag without pictures", refuses="holds no picture; .* its topics are: /depth")
def _no_pictures(dive: Dive, folder: Path) -> Made:
    messages = Messages(ros1=False)
    pressure = messages.make("sensor_msgs/msg/FluidPressure", messages.header(BEGAN_NS), 2e5, 0.0)
    return made(dive, write_bag(folder / "bag", messages, [("/depth", 0, pressure)]))


@row("bag with --fps", near=0.0, says="--fps is not used: bag has times of its own")
def _fps(dive: Dive, folder: Path) -> Made:
    messages = Messages(ros1=False)
    path = write_bag(folder / "bag", messages, pictures_of(messages, dive))
    return made(dive, path, fps=5.0)


@row("bag with --fps and --topic", refuses=f"has times of its own on {TOPIC}; leave out --fps")
def _fps_and_topic(dive: Dive, folder: Path) -> Made:
    return replace(_fps(dive, folder), topic=TOPIC)


def _mcap(
    path: Path, name: str, schema: tuple[str, bytes], encoding: str, payloads: Sequence[bytes],
    dive: Dive,
) -> Path:  # fmt: skip
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=150_000, compression=CompressionType.NONE)
        writer.start()
        channel = writer.register_channel(
            "/cam/image", encoding, writer.register_schema(name, *schema)
        )
        for t_s, payload in zip(dive.times_s, payloads, strict=True):
            stamp = BEGAN_NS + round(t_s * 1e9)
            writer.add_message(channel, stamp + LATE_NS, payload, stamp)
        writer.finish()
    return path


@row("MCAP Foxglove JSON", near=0.0)
def _foxglove_json(dive: Dive, folder: Path) -> Made:
    payloads = []
    for each in dive.pictures:
        data = base64.b64encode(cv2.imencode(".png", each[..., ::-1])[1].tobytes()).decode()
        payloads.append(json.dumps({"format": "png", "data": data, "frame_id": "x"}).encode())
    schema = ("jsonschema", b"{}")
    path = folder / "a.mcap"
    return made(dive, _mcap(path, "foxglove.CompressedImage", schema, "json", payloads, dive))


def _protobuf(kind: Any) -> tuple[str, bytes]:
    from mcap_protobuf.schema import build_file_descriptor_set

    return "protobuf", build_file_descriptor_set(kind).SerializeToString()


@row("MCAP Foxglove RawImage", near=0.0)
def _raw_image(dive: Dive, folder: Path) -> Made:
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

    payloads = [
        RawImage(width=160, height=120, step=480, encoding="rgb8", data=each.tobytes())
        .SerializeToString()
        for each in dive.pictures
    ]  # fmt: skip
    schema = _protobuf(RawImage)
    path = folder / "a.mcap"
    return made(dive, _mcap(path, "foxglove.RawImage", schema, "protobuf", payloads, dive))


@row("MCAP Foxglove CompressedVideo", needs="ffmpeg")
def _compressed_video(dive: Dive, folder: Path) -> Made:
    from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo

    stream = film(
        folder / "a.h264", dive.pictures, "libx264", "-pix_fmt", "yuv420p", "-bf", "0",
        "-x264-params", "aud=1",
    )  # fmt: skip
    mark = b"\x00\x00\x00\x01\x09"
    units = [mark + part for part in stream.read_bytes().split(mark)[1:]]
    payloads = [CompressedVideo(format="h264", data=unit).SerializeToString() for unit in units]
    schema = _protobuf(CompressedVideo)
    path = folder / "a.mcap"
    return made(dive, _mcap(path, "foxglove.CompressedVideo", schema, "protobuf", payloads, dive))


@row("MCAP cut off", near=0.0, says="was cut off; all before its end is used")
def _cut(dive: Dive, folder: Path) -> Made:
    read = _raw_image(dive, folder)
    # Half of the last picture is missing; the chunk of three that was being written goes with it.
    read.source.write_bytes(read.source.read_bytes()[:-40_000])
    return replace(read, pictures=dive.pictures[:-2], times_s=dive.times_s[:-2])


@row("MCAP that is none", refuses="is not an MCAP file, whatever its name")
def _no_mcap(dive: Dive, folder: Path) -> Made:
    (folder / "a.mcap").write_bytes(b"#ROSBAG V2.0\n" + bytes(500))
    return made(dive, folder / "a.mcap")
