"""Folders of pictures as people have them: times in names, and the level of white."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.recordings import images
from aquaflow.recordings.images import ImageFolder
from aquaflow.types import Frame

GREY = np.full((32, 48), 40, np.uint8)


def folder_of(folder: Path, names: list[str]) -> ImageFolder:
    for name in names:
        cv2.imwrite(str(folder / name), GREY)
    return ImageFolder(folder)


NAMED = [
    (["0.133.png", "0.4.png", "1.05.png"], [0.0, 0.267, 0.917]),
    (["frame_9.5.png", "frame_10.25.png"], [0.0, 0.75]),
    (["1403636579763555584.png", "1403636579813555456.png"], [0.0, 0.049999872]),
    (["1305031102.175304.png", "1305031102.211214.png"], [0.0, 0.03591]),
    (["1700000000123.jpg", "1700000000623.jpg"], [0.0, 0.5]),
    (["2024-05-01T10-00-59.900.png", "2024-05-01T10-01-00.100.png"], [0.0, 0.2]),
    (["20240501_100059_500.png", "20240501_100101_000.png"], [0.0, 1.5]),
    (["DJI_20240501235958_0001_W.JPG", "DJI_20240502000001_0002_W.JPG"], [0.0, 3.0]),
    (["cam_1700000000.png", "cam_1700000002.png"], [0.0, 2.0]),
]


@pytest.mark.parametrize(("names", "expected_s"), NAMED)
def test_times_in_names_are_used(tmp_path: Path, names: list[str], expected_s: list[float]) -> None:
    camera = folder_of(tmp_path, names)
    assert [file.name for file in camera.files] == names
    assert [f.t_ns * 1e-9 for f in camera.frames()] == pytest.approx(expected_s, abs=1e-9)
    assert "in their names" in camera.notes[0]


@pytest.mark.parametrize("names", [["GOPR0001.JPG", "GOPR0002.JPG"], ["2.png", "10.png"]])
def test_an_assumed_rate_is_said(tmp_path: Path, names: list[str]) -> None:
    camera = folder_of(tmp_path, names)
    assert [file.name for file in camera.files] == names
    assert [f.t_ns for f in camera.frames()] == [0, 100_000_000]
    assert "10 a second are assumed" in camera.notes[0]


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("bits", [12, 16])
def test_white_is_one_level_for_the_folder(
    tmp_path: Path, suffix: str, channels: int, bits: int
) -> None:
    shape = (32, 48) if channels == 1 else (32, 48, 3)
    dark = np.full(shape, 200 << (bits - 12), np.uint16)
    bright = np.full(shape, 3000 << (bits - 12), np.uint16)
    cv2.imwrite(str(tmp_path / f"1{suffix}"), dark if bits == 12 else dark // 16)
    cv2.imwrite(str(tmp_path / f"2{suffix}"), bright)
    camera = ImageFolder(tmp_path)
    first, second = (f.image for f in camera.frames() if isinstance(f, Frame))
    assert second.max() == 3000 * 256 // 4096
    assert first.max() == (200 if bits == 12 else 12) * 256 // 4096
    assert any(f"white is assumed to be {(1 << bits) - 1}" in note for note in camera.notes)


def test_colours_of_16_bits_keep_their_order(tmp_path: Path) -> None:
    bgr = np.zeros((32, 48, 3), np.uint16)
    bgr[..., 2] = 65535
    cv2.imwrite(str(tmp_path / "1.png"), bgr)
    (frame,) = ImageFolder(tmp_path).frames()
    assert isinstance(frame, Frame)
    assert frame.image[0, 0].tolist() == [255, 0, 0]


LISTS = [
    ("#timestamp [ns],filename\n1403636579763555584,{}\n1403636579813555456,{}\n", 0.049999872),
    ("#timestamp [ns],filename\n100000000,{}\n250000000,{}\n", 0.15),
    ("# color images\n# file: 'a.bag'\n# timestamp filename\n1305031102.1 rgb/{}\n"
     "1305031102.4 rgb/{}\n", 0.3),
    ("name,time (ms)\n{},100\n{},250\n", 0.15),
    ("{};1700000000123\n{};1700000000623\n", 0.5),
    ('"file","quality","time_s"\r\n"{}","7","12.5"\r\n"{}","3","13"\r\n', 0.5),
    ("1403636579763555584 {}\n1403636579813555456 {}\n", 0.049999872),
]  # fmt: skip


@pytest.mark.parametrize(("text", "expected_s"), LISTS)
@pytest.mark.parametrize("above", [False, True])
def test_a_table_that_names_the_pictures_has_their_times(
    tmp_path: Path, text: str, expected_s: float, above: bool
) -> None:
    pictures = tmp_path / "data"
    pictures.mkdir()
    folder_of(pictures, names := ["frame_1.png", "frame_2.png"])
    table = (tmp_path if above else pictures) / "list.csv"
    table.write_text(text.format(*names))
    camera = ImageFolder(tmp_path)
    assert [f.t_ns * 1e-9 for f in camera.frames()] == pytest.approx([0.0, expected_s], abs=1e-9)
    assert camera.notes[0] == f"the times of the pictures are those of {table}"


@pytest.mark.parametrize(
    "text",
    [
        "0,1.png\n1,2.png\n",
        "file,latitude,longitude\n1.png,-41.25,174.8\n2.png,-41.24,174.9\n",
        "time,file\n1.0,1.png\n",
        "time,file\n2.0,1.png\n1.0,2.png\n",
        "1.png\n2.png\n",
        "\xff",
    ],
)
def test_a_table_without_a_time_for_each_picture_is_left_alone(tmp_path: Path, text: str) -> None:
    (tmp_path / "list.csv").write_bytes(text.encode("latin-1"))
    camera = folder_of(tmp_path, ["1.png", "2.png"])
    assert "10 a second are assumed" in camera.notes[0]


def test_of_a_log_that_names_no_picture_only_the_beginning_is_read() -> None:
    read = list[int]()

    def log() -> Iterator[str]:
        for second in range(10_000):
            read.append(second)
            yield f"{second},0.1,0.2\n"

    assert images._times_of_lines(log()) == {}
    assert len(read) == images.LONGEST_HEADER + 1


def test_a_camera_of_eurocs_layout_is_read_with_its_calibration(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    folder_of(tmp_path / "data", ["1403636579763555584.png", "1403636579813555456.png"])
    (tmp_path / "sensor.yaml").write_text(
        "resolution: [48, 32]\ncamera_model: pinhole\nintrinsics: [40, 41, 23.5, 15.5]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
    )
    camera = ImageFolder(tmp_path).camera
    assert camera is not None
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 41, 24, 16)
