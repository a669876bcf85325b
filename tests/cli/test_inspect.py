"""``aquaflow inspect``: what would be read of every kind of recording, in words and as JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.geometry.camera import save_camera
from aquaflow.recordings.images import ImageFolder
from tests.command_line import Cli, refused
from tests.recordings.inputs import Dive, dive_of, made, write_plainly
from tests.recordings.inputs.bags import Messages, pictures_of, write_bag


@pytest.fixture(scope="module")
def dive(small_recording: Path) -> Dive:
    return dive_of(small_recording)


def clip(path: Path, dive: Dive) -> Path:
    size = (dive.camera.width, dive.camera.height)
    code = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, 10.0, size)
    for picture in dive.pictures:
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    writer.release()
    return path


def bag(path: Path, dive: Dive, single: bool) -> Path:
    messages = Messages(ros1=False)
    info = ("/cam/camera_info", 0, messages.camera_info(dive.camera))
    pressure = messages.make("sensor_msgs/msg/FluidPressure", messages.header(17 * 10**17), 2e5, 0)
    events = [info, ("/depth", 10**8, pressure), *pictures_of(messages, dive)]
    if not single:
        return write_bag(path, messages, events)
    from rosbags.rosbag2 import StoragePlugin

    write_bag(path, messages, events, storage=StoragePlugin.MCAP)
    (path / "metadata.yaml").unlink()
    (file,) = path.iterdir()
    return file


def test_a_folder_in_words(command: Cli, dive: Dive, tmp_path: Path) -> None:
    folder = write_plainly(tmp_path / "plain", made(dive, tmp_path), dive.camera)
    ran = command("inspect", folder)
    assert ran.code == 0
    lines = [" ".join(line.split()) for line in ran.out.splitlines()]
    assert lines == [
        f"source {folder}",
        "pictures 14",
        "size 160 x 120",
        "rate_hz 10.0",
        "calibration fx 136.0 px of 160, none",
        f"times from the times of the pictures are those of {folder / 'timestamps.txt'}",
        f"calibration from the calibration is {folder / 'camera.yaml'}",
    ]


def test_a_clip_as_json(command: Cli, dive: Dive, tmp_path: Path) -> None:
    path = clip(tmp_path / "clip.avi", dive)
    found = json.loads(command("inspect", path, "--json").out)
    assert found == {
        "source": str(path),
        "pictures": 14,
        "size": "160 x 120",
        "rate_hz": 10.0,
        "calibration": "none: a focal length is assumed and refined",
        "sources": {"times": "rate: 10 pictures a second, from the container"},
        "notes": [],
        "odd": [],
    }


@pytest.mark.parametrize("single", [False, True])
def test_a_bag_and_a_single_mcap_say_the_same(
    command: Cli, dive: Dive, tmp_path: Path, single: bool
) -> None:
    path = bag(tmp_path / "bag", dive, single)
    found = json.loads(command("inspect", path, "--json").out)
    assert (found["pictures"], found["size"], found["rate_hz"]) == (14, "160 x 120", 10.0)
    assert found["calibration"].startswith("fx 136.0 px of 160")
    said = found["sources"]["calibration"]
    assert said.startswith("the calibration of /cam/image_raw is that of /cam/camera_info")
    kinds = [(each["kind"], each["read"], each["from_s"]) for each in found["telemetry"]]
    assert kinds == [("Depth", 1, 0.0), ("UtcTime", 1, pytest.approx(0.12))]


def test_a_folder_with_one_video_and_its_calibration_is_that_video(
    command: Cli, dive: Dive, tmp_path: Path
) -> None:
    folder = tmp_path / "reef"
    folder.mkdir()
    path = clip(folder / "clip.avi", dive)
    save_camera(dive.camera, folder / "camera.yaml")
    found = json.loads(command("inspect", folder, "--json").out)
    assert (found["source"], found["pictures"]) == (str(folder), 14)
    assert found["sources"]["calibration"] == f"the calibration is {folder / 'camera.yaml'}"
    given = ("map", folder, "--tracking-only", "--every", 13, "--out", tmp_path / "out")
    refused(command(*given), "reef has 2 usable frames")
    path.with_suffix(".mkv").write_bytes(path.read_bytes())
    refused(command("inspect", folder), "are camera.yaml, clip.avi, clip.mkv")


def test_a_log_alone_and_what_holds_nothing(command: Cli, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t_s,depth_m\n0.5,3\n2.5,4\n")
    assert (
        "Depth: 2, at 0.50 to 2.50 s after the beginning"
        in command("inspect", tmp_path / "a.csv").out
    )
    (tmp_path / "a.nmea").write_text("nothing\n")
    assert "nothing that is known" in command("inspect", tmp_path / "a.nmea").out


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.mp4", b"\x00" * 2000, "cannot be read as a video"),
        ("a.mcap", b"#ROSBAG V2.0" + b"\x00" * 500, "is not an MCAP file"),
        ("a.bag", b"#ROSBAG V2.0\n" + b"\x00" * 300, "cannot read the bag"),
        ("a.docx", b"PK", "no installed source reads"),
    ],
)
def test_what_is_broken_is_one_sentence(
    command: Cli, tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    (tmp_path / name).write_bytes(content)
    ran = command("inspect", tmp_path / name)
    assert ran.code == 1
    assert words in ran.err
    assert len(ran.err.splitlines()) == 1


def test_no_more_than_a_few_seconds_are_read(
    command: Cli, dive: Dive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(import_module("aquaflow.cli.doctor"), "MOST_FRAMES", 4)
    folder = write_plainly(tmp_path / "plain", made(dive, tmp_path), dive.camera)
    read: list[int] = []
    one = ImageFolder._frame
    monkeypatch.setattr(ImageFolder, "_frame", lambda self, k: read.append(k) or one(self, k))
    assert "pictures  14" in command("inspect", folder).out
    assert read == [0, 1, 2, 3]


def test_what_is_odd_is_said(command: Cli, dive: Dive, tmp_path: Path) -> None:
    black = replace(dive, pictures=[picture // 100 for picture in dive.pictures])
    folder = write_plainly(tmp_path / "plain", made(black, tmp_path), dive.camera)
    assert "14 of 14 pictures are nearly black" in command("inspect", folder).out


def test_a_stream_of_sensors_that_is_not_read_is_named(
    command: Cli, dive: Dive, tmp_path: Path
) -> None:
    """As in the files of a GoPro; the index is in front of what it describes."""
    path = tmp_path / "clip.mp4"
    code = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, 10.0, (160, 120))
    writer.write(np.ascontiguousarray(dive.pictures[0][..., ::-1]))
    writer.release()
    entry = (
        b"stsd" + bytes(4) + (1).to_bytes(4, "big") + (16).to_bytes(4, "big") + b"gpmd" + bytes(8)
    )
    inside = (8 + len(entry)).to_bytes(4, "big") + b"free" + entry
    data = path.read_bytes()
    at = data.index(b"moov") - 4
    size = int.from_bytes(data[at : at + 4], "big")
    longer = (size + len(inside)).to_bytes(4, "big")
    path.write_bytes(data[:at] + longer + data[at + 4 : at + size] + inside + data[at + size :])
    assert (
        "sensors from  what the sensors measured is not read: GoPro" in command("inspect", path).out
    )


def test_blank_pictures_are_named_before_they_are_mapped(
    command: Cli, dive: Dive, tmp_path: Path, contained: None
) -> None:
    black = replace(dive, pictures=[np.full_like(picture, 3) for picture in dive.pictures])
    folder = write_plainly(tmp_path / "plain", made(black, tmp_path), dive.camera)
    ran = command("map", folder, "--out", tmp_path / "dive", "--tracking-only")
    assert ran.code != 0
    lines = ran.err.splitlines()
    assert lines[0] == "Note: before mapping: 10 of 10 pictures are nearly black."
    assert "none of 14 frames could be placed: 14 of 14 pictures are nearly black" in lines[-1]
