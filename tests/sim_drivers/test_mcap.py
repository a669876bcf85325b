"""MCAP recordings of others, and video in them; our own are in tests/recording."""

from __future__ import annotations

import base64
import errno
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, cast

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from mcap import stream_reader
from mcap.writer import Writer

from aquaflow.base.errors import InputError
from aquaflow.config.link import SerialConfig
from aquaflow.config.service import RecordingConfig
from aquaflow.config.telemetry import NmeaConfig
from aquaflow.geometry.camera import guess_camera
from aquaflow.live.recorder import Recorder
from aquaflow.live.recorder.writing import encode
from aquaflow.recordings import mcap_messages
from aquaflow.recordings.h264 import is_key
from aquaflow.recordings.mcap_camera import McapCamera
from aquaflow.recordings.mcap_messages import McapMessages
from aquaflow.recordings.mcap_telemetry import McapTelemetry
from aquaflow.recordings.video import VideoFile
from aquaflow.sources import camera_reader, open_recorded_telemetry, open_recording
from aquaflow.types import Attitude, Depth, Dropped, EncodedPicture, Frame

Write = Callable[[Writer], None]
RED = np.zeros((4, 6, 3), np.uint8) + np.array([200, 10, 30], np.uint8)
PNG = encode(RED, RecordingConfig(picture="png")).data


def written(path: Path, write: Write, chunked: bool = True) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=chunked)
        writer.start()
        write(writer)
        writer.finish()
    return path


def with_messages(
    name: str,
    schema: tuple[str, bytes],
    encoding: str,
    payloads: list[bytes],
    topic: str = "/cam/a",
) -> Write:
    def write(writer: Any) -> None:
        schema_id = writer.register_schema(name, *schema)
        channel = writer.register_channel(topic, encoding, schema_id)
        for k, payload in enumerate(payloads):
            stamp = (100 + k) * 10**9
            writer.add_message(channel, stamp + 5, payload, stamp)

    return write


def colours(path: Path) -> list[list[int]]:
    frames = list(open_recording(path).frames())
    assert all(isinstance(frame, Frame) for frame in frames)
    return [frame.image[2, 3].tolist() for frame in frames if isinstance(frame, Frame)]


@pytest.mark.parametrize("chunked", [True, False])
def test_foxgloves_json_pictures_are_read(tmp_path: Path, chunked: bool) -> None:
    data = base64.b64encode(PNG).decode()
    payload = json.dumps({"format": "png", "data": data, "frame_id": "x"}).encode()
    write = with_messages("foxglove.CompressedImage", ("jsonschema", b"{}"), "json", [payload] * 2)
    path = written(tmp_path / "a.mcap", write, chunked)
    assert colours(path) == [[200, 10, 30]] * 2
    frames = list(open_recording(path).frames())
    assert [(frame.index, frame.t_ns) for frame in frames] == [(0, 0), (1, 10**9)]


@pytest.mark.parametrize(
    ("encoding", "pixels", "step"),
    [
        ("rgb8", RED, 18),
        ("bgr8", RED[..., ::-1], 18),
        ("rgba8", np.dstack([RED, RED[..., :1]]), 24),
        ("mono8", RED[..., 0], 6),
        ("16UC1", (RED[..., 0].astype("<u2") << 4), 12),
    ],
)
def test_foxgloves_raw_pictures_are_read(
    tmp_path: Path, encoding: str, pixels: npt.NDArray[np.uint8], step: int
) -> None:
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
    from mcap_protobuf.schema import build_file_descriptor_set

    data = np.ascontiguousarray(pixels).tobytes()
    message = RawImage(width=6, height=4, step=step, encoding=encoding, data=data)
    schema = build_file_descriptor_set(RawImage).SerializeToString()
    payload = message.SerializeToString()
    write = with_messages("foxglove.RawImage", ("protobuf", schema), "protobuf", [payload])
    expected = [200, 10, 30] if step in (18, 24) else [200, 200, 200]
    assert colours(written(tmp_path / "a.mcap", write)) == [expected]


def test_ros_2_pictures_in_mcap_are_read(tmp_path: Path) -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](1, 0)
    header = types["std_msgs/msg/Header"](stamp, "x")
    name = "sensor_msgs/msg/CompressedImage"
    picture = types[name](header, "png", np.frombuffer(PNG, np.uint8))
    payload = bytes(store.serialize_cdr(picture, name))
    definition = store.generate_msgdef(name, ros_version=2)[0].encode()
    write = with_messages(name, ("ros2msg", definition), "cdr", [payload])
    assert colours(written(tmp_path / "a.mcap", write)) == [[200, 10, 30]]


def test_a_picture_that_cannot_be_decoded_costs_itself(tmp_path: Path) -> None:
    payloads = [json.dumps({"data": base64.b64encode(d).decode()}).encode() for d in (PNG, b"no")]
    payloads.append(b"{not json")
    write = with_messages("foxglove.CompressedImage", ("jsonschema", b"{}"), "json", payloads)
    frames = list(McapCamera(written(tmp_path / "a.mcap", write)).frames())
    assert [type(frame) for frame in frames] == [Frame, Dropped, Dropped]
    assert isinstance(frames[1], Dropped)
    assert frames[1].reason == "a.mcap#1 is damaged or cut off"


def test_a_file_without_pictures_or_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", with_messages("x", ("jsonschema", b"{}"), "json", [b"{}"]))
    with pytest.raises(InputError, match="holds no picture"):
        open_recording(path)
    (tmp_path / "b.mcap").write_bytes(b"RIFFxxxxAVI no mcap at all, but long enough")
    with pytest.raises(InputError, match="is not an MCAP file"):
        open_recording(tmp_path / "b.mcap")


def test_a_folder_of_pictures_is_no_mcap_recording(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(PNG)
    reader = camera_reader(tmp_path)
    assert reader is not None
    assert reader is not McapCamera


def test_frames_can_be_chosen(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, RecordingConfig(picture="raw", reserve_mb=0))
    for k in range(10):
        recorder.frame("c", Frame(k, k, k, RED, guess_camera(6, 4)))
    recorder.close()
    chosen = McapCamera(tmp_path).frames(every=3, start=2, stop=9)
    assert [frame.index for frame in chosen] == [2, 5, 8]


def test_links_decoded_again_give_the_samples_that_were_decoded_live(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, RecordingConfig(reserve_mb=0))
    recorder.raw("compass", 50, b"$PRDID,1.00,-2.00,35")
    recorder.raw("compass", 60, b"0.00*51\r\n$GARBAGE")
    recorder.raw("unknown", 70, b"xyz")
    recorder.sample(Depth(80, 80, "d", 1.0))
    recorder.close()
    telemetry = McapTelemetry(tmp_path, origin_ns=0)
    (again,) = telemetry.decoded_again({"compass": NmeaConfig(link=SerialConfig(port="log"))})
    assert isinstance(again, Attitude)
    assert (again.arrival_ns, again.source) == (60, "compass/PRDID")
    assert list(open_recorded_telemetry(tmp_path).samples()) != []


def access_units(clip: Path, count: int) -> list[bytes]:
    capture = cv2.VideoCapture(str(clip), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    return [capture.read()[1].tobytes() for _ in range(count)]


def record_video(out: Path, units: list[bytes]) -> None:
    recorder = Recorder(out, RecordingConfig(reserve_mb=0))
    image = np.zeros((1080, 1920, 3), np.uint8)[:1, :1]
    for k, unit in enumerate(units):
        received = EncodedPicture("h264", unit, is_key(unit))
        camera = guess_camera(1920, 1080)
        recorder.frame("c", Frame(k, k * 10**7, k * 10**7, image, camera, encoded=received))
    assert recorder.close().dropped == {}


def test_video_as_received_replays_to_the_pictures_of_the_stream(
    shared_data: Path, tmp_path: Path
) -> None:
    """Every unit of the clip, since it has B-frames, which live encoders do not send."""
    clip = shared_data / "reef_clip" / "reef_clip.mp4"
    record_video(tmp_path, access_units(clip, 211))
    camera = McapCamera(tmp_path)
    pairs = zip(camera.frames(stop=6), VideoFile(clip).frames(stop=6), strict=True)
    for mine, theirs in pairs:
        assert isinstance(mine, Frame)
        assert isinstance(theirs, Frame)
        assert mine.t_ns == mine.index * 10**7
        assert mine.encoded is not None
        assert np.array_equal(mine.image, theirs.image)


def test_video_before_its_first_key_frame_is_missing(shared_data: Path, tmp_path: Path) -> None:
    units = access_units(shared_data / "reef_clip" / "reef_clip.mp4", 3)
    record_video(tmp_path, [units[1], units[2], units[0]])
    frames = list(McapCamera(tmp_path).frames())
    assert [type(frame) for frame in frames] == [Dropped, Dropped, Frame]
    assert [frame.index for frame in frames] == [0, 1, 2]


class FailingOnce:
    """A file of which one read raises."""

    def __init__(self, file: BinaryIO, at: int) -> None:
        self._file, self._at, self.reads = file, at, 0

    def tell(self) -> int:
        return self._file.tell()

    def seek(self, at: int) -> int:
        return self._file.seek(at)

    def read(self, size: int = -1) -> bytes:
        self.reads += 1
        if self.reads == self._at:
            raise OSError(errno.EIO, "Input/output error")
        return self._file.read(size)


@pytest.mark.parametrize("at", [1, 4, 9])
def test_a_read_that_fails_once_costs_nothing(at: int) -> None:
    file = FailingOnce(io.BytesIO(bytes(range(100))), at)
    whole = mcap_messages._Whole(cast("BinaryIO", file))
    assert b"".join(whole.read(10) for _ in range(10)) == bytes(range(100))


def test_a_chunk_that_cannot_be_unpacked_at_first_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    payload = json.dumps({"format": "png", "data": base64.b64encode(PNG).decode()}).encode()
    write = with_messages("foxglove.CompressedImage", ("jsonschema", b"{}"), "json", [payload])
    path = written(tmp_path / "a.mcap", write)
    unpack, calls = stream_reader.breakup_chunk, []

    def failing_once(*arguments: Any, **options: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 1:
            raise ValueError("planted")
        return unpack(*arguments, **options)

    monkeypatch.setattr(stream_reader, "breakup_chunk", failing_once)
    assert len(list(McapMessages([path]))) == 1


def test_a_recording_that_cannot_be_read_any_more_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    payload = json.dumps({"format": "png", "data": base64.b64encode(PNG).decode()}).encode()
    write = with_messages("foxglove.CompressedImage", ("jsonschema", b"{}"), "json", [payload])
    recording = McapCamera(written(tmp_path / "a.mcap", write))

    def refused(*_: object) -> BinaryIO:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(InputError, match=r"no picture any more: a\.mcap cannot be read: Input"):
        list(recording.frames())
