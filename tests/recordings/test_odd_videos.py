"""Videos as people have them, against the same pictures read plainly."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.camera import guess_camera, save_camera
from aquaflow.recordings import video_decoder
from aquaflow.recordings.h264 import decode_units
from aquaflow.recordings.video import VideoFile
from aquaflow.types import Dropped, Frame
from tests.recordings.inputs.films import film

SIDE, COUNT, FPS = 96, 12, 20.0
LEAST_DEINTERLACED_DB = 40.0
"""PSNR of a deinterlaced picture, measured 42.2; woven as they are the fields have 28.5."""
NEAR = 4.0
"""Grey levels that two encodings of one picture differ by at most, on average."""

Picture = npt.NDArray[np.uint8]

needs_ffmpeg = pytest.mark.skipif(
    shutil.which("ffmpeg") is None, reason="the program ffmpeg is not installed"
)


def pictures() -> list[Picture]:
    """[SIDE, SIDE, 3] BGR: smooth grey texture that moves to the right."""
    import cv2

    rng = np.random.default_rng(4)
    wide = cv2.GaussianBlur(rng.integers(0, 255, (SIDE, 2 * SIDE), np.uint8), (0, 0), 3.0)
    wide = cv2.cvtColor(cv2.normalize(wide, None, 20, 230, cv2.NORM_MINMAX), cv2.COLOR_GRAY2BGR)
    return [np.ascontiguousarray(wide[:, 2 * i : 2 * i + SIDE]) for i in range(COUNT)]


def write(path: Path, code: str, frames: list[Picture] | None = None) -> Path:
    import cv2

    frames = pictures() if frames is None else frames
    size = (frames[0].shape[1], frames[0].shape[0])
    fourcc = cv2.VideoWriter.fourcc(*code)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, FPS, size)
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def flag_interlaced(data: bytes) -> bytes:
    """MPEG-2 whose sequences and pictures say that they are not progressive (ISO 13818-2)."""
    out = bytearray(data)
    for match in re.finditer(rb"\x00\x00\x01\xb5", data):
        at = match.end()
        if data[at] >> 4 == 1:
            out[at + 1] &= ~0x08
        elif data[at] >> 4 == 8:
            out[at + 4] &= ~0x80
    return bytes(out)


def difference(frame: Frame, bgr: Picture) -> float:
    return float(np.abs(frame.image[..., ::-1].astype(int) - bgr.astype(int)).mean())


def read(path: Path) -> tuple[VideoFile, list[Frame | Dropped]]:
    source = VideoFile(path)
    return source, list(source.frames())


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("clip.M2TS", "MPG2"),
        ("clip.mjpeg", "MJPG"),
        ("10:30:00.avi", "MJPG"),
    ],
)
def test_containers_give_the_same_pictures_and_their_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, code: str
) -> None:
    monkeypatch.chdir(tmp_path)
    plain = tmp_path / f"plain{Path(name).suffix.replace('.M2TS', '.ts')}"
    write(plain, code).rename(name)
    assert VideoFile.recognises(Path(name))
    source, frames = read(Path(name))
    assert len(frames) == COUNT
    for frame, bgr in zip(frames, pictures(), strict=True):
        assert isinstance(frame, Frame)
        assert difference(frame, bgr) < NEAR, frame.index
    assert source.notes[0].startswith("rate: ")


@needs_ffmpeg
@pytest.mark.parametrize("flagged", [range(COUNT), range(5, COUNT)])
def test_pictures_flagged_as_interlaced_are_read_as_they_are(
    tmp_path: Path, flagged: range
) -> None:
    path = tmp_path / "clip.m2v"
    plain = write(tmp_path / "plain.m2v", "MPG2", pictures()[: flagged[0]]) if flagged[0] else None
    rest = write(tmp_path / "rest.m2v", "MPG2", pictures()[flagged[0] :])
    path.write_bytes((plain.read_bytes() if plain else b"") + flag_interlaced(rest.read_bytes()))
    source, frames = read(path)
    assert len(frames) == COUNT
    for frame, bgr in zip(frames, pictures(), strict=True):
        assert isinstance(frame, Frame)
        assert difference(frame, bgr) < NEAR, frame.index
    said = f"clip.m2v is interlaced from frame {flagged[0]} on; FFmpeg decodes"
    assert any(note.startswith(said) for note in source.notes)


def test_interlaced_video_without_the_program_ffmpeg_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video_decoder, "FFMPEG", "no-such-program")
    path = write(tmp_path / "clip.m2v", "MPG2")
    path.write_bytes(flag_interlaced(path.read_bytes()))
    _, frames = read(path)
    assert len(frames) == COUNT
    for frame in frames:
        assert isinstance(frame, Dropped)
        assert "is interlaced, which OpenCV does not decode; install FFmpeg" in frame.reason


def test_pictures_that_the_decoder_complains_about_are_counted_and_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "clip.m2v", "MPG2")
    data = bytearray(path.read_bytes())
    starts = [match.start() for match in re.finditer(rb"\x00\x00\x01\x00", data)]
    at = (starts[6] + starts[7]) // 2
    data[at : at + 40] = bytes(range(7, 47))
    path.write_bytes(data)
    capfd.readouterr()
    source, frames = read(path)
    lost = [frame.index for frame in frames if isinstance(frame, Dropped)]
    assert len(frames) == COUNT
    assert 6 in lost
    assert lost == list(range(lost[0], COUNT)), "all after it are made from it"
    assert all("is damaged: " in frame.reason for frame in frames if isinstance(frame, Dropped))
    assert any(f"{len(lost)} frames of clip.m2v were left out" in note for note in source.notes)
    assert any(note.startswith("the first error in clip.m2v: ") for note in source.notes)
    assert capfd.readouterr() == ("", "")


def test_pixels_of_the_container_are_made_square(tmp_path: Path) -> None:
    path = write(tmp_path / "clip.m2v", "MPG2")
    data = bytearray(path.read_bytes())
    for match in re.finditer(rb"\x00\x00\x01\xb3", bytes(data)):
        data[match.end() + 3] = 0x20 | data[match.end() + 3] & 0x0F  # shown as 4:3
    path.write_bytes(data)
    source, frames = read(path)
    assert (source.width, source.height) == (SIDE * 4 // 3, SIDE)
    assert {frame.image.shape for frame in frames if isinstance(frame, Frame)} == {(96, 128, 3)}
    assert source.notes[1] == (
        "pixels: 1.333 wide and 1 high; pictures of 96 x 96 are stretched to 128 x 96, from the "
        "container"
    )


def test_a_calibration_that_does_not_fit_is_named(tmp_path: Path) -> None:
    save_camera(guess_camera(160, 90), tmp_path / "camera.yaml")
    source, _ = read(write(tmp_path / "clip.avi", "MJPG"))
    assert source.camera is None
    assert source.notes[1] == (
        f"{tmp_path / 'camera.yaml'} is not used: it is for pictures of 160 x 90, those of "
        "clip.avi are 96 x 96; if it is for the cropped ones, give it with --calib"
    )


@pytest.mark.parametrize(
    "names",
    [("GX010042.MP4", "GX020042.MP4", "GX030042.MP4"), ("GOPR0042.MP4", "GP010042.MP4")],
)
def test_chapters_of_a_gopro_are_one_recording(tmp_path: Path, names: tuple[str, ...]) -> None:
    part = COUNT // len(names)
    for place, name in enumerate(names):
        write(tmp_path / name, "mp4v", pictures()[place * part : (place + 1) * part])
    write(tmp_path / "GX010043.MP4", "mp4v")
    source, frames = read(tmp_path / names[0])
    assert source.frame_count == COUNT
    assert [frame.t_ns for frame in frames] == [50_000_000 * i for i in range(COUNT)]
    for frame, bgr in zip(frames, pictures(), strict=True):
        assert isinstance(frame, Frame)
        assert difference(frame, bgr) < NEAR, frame.index
    assert f"chapters of one recording: {', '.join(names)}" in source.notes


@needs_ffmpeg
def test_units_made_from_a_damaged_one_are_none_up_to_the_next_whole_one(tmp_path: Path) -> None:
    options = ("-pix_fmt", "yuv420p", "-bf", "0", "-x264-params", "aud=1:keyint=5:scenecut=0")
    stream = film(tmp_path / "a.h264", pictures(), "libx264", *options).read_bytes()
    mark = b"\x00\x00\x00\x01\x09"  # an access unit delimiter (H.264, 7.3.2.4)
    units = [mark + part for part in stream.split(mark)[1:]]
    size, rng = len(units[6]), np.random.default_rng(0)
    units[6] = units[6][: size // 3] + rng.bytes(size - size // 3)
    decoded = list(decode_units(iter(enumerate(units))))
    assert [label for label, _ in decoded] == list(range(COUNT))
    assert [label for label, picture in decoded if picture is None] == [6, 7, 8, 9]


@needs_ffmpeg
def test_fields_of_two_moments_become_the_pictures_of_the_first(tmp_path: Path) -> None:
    """50 fields a second: lines of the second field are 2 px ahead of those of the first."""
    whole = pictures()
    woven = [each.copy() for each in whole[:-1]]
    for each, later in zip(woven, whole[1:], strict=True):
        each[1::2] = later[1::2]
    options = ("-pix_fmt", "yuv420p", "-flags", "+ildct+ilme", "-x264-params", "tff=1")
    _, frames = read(film(tmp_path / "a.mts", woven, "libx264", *options))
    found = [frame.image for frame in frames if isinstance(frame, Frame)]
    assert len(found) == len(woven)
    decibels = [psnr(a, b) for a, b in zip(found, whole[:-1], strict=True)]
    assert min(decibels) > LEAST_DEINTERLACED_DB


def psnr(a: Picture, b: Picture) -> float:
    return float(-10.0 * np.log10(np.mean((a.astype(float) - b) ** 2) / 255.0**2))
