"""Videos as people have them: containers and codecs, pixel shapes, interlaced, damaged."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.base.errors import InputError
from aquaflow.geometry.camera import guess_camera
from aquaflow.geometry.camera_file import save_camera
from aquaflow.recordings import video
from aquaflow.recordings.decoder_log import DecoderLog
from aquaflow.recordings.video import VideoFile
from aquaflow.sources import camera_reader
from aquaflow.types import Frame

W, H, COUNT, FPS = 96, 64, 8, 25.0
CONTAINERS = [
    *(("mp4v", suffix) for suffix in (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".3gp")),
    *(("MJPG", suffix) for suffix in (".avi", ".mov", ".mkv", ".mp4")),
    *(("mpg2", suffix) for suffix in (".mpg", ".mpeg", ".vob", ".ts", ".mts", ".m2ts", ".mkv")),
    *(("FFV1", suffix) for suffix in (".mkv", ".avi")),
    *(("VP80", ".webm"), ("VP90", ".webm"), ("FLV1", ".flv"), ("WMV2", ".wmv"), ("WMV2", ".asf")),
]


def picture(number: int) -> npt.NDArray[np.uint8]:
    """Broad waves that move: every codec keeps them."""
    x, y = np.meshgrid(np.arange(W), np.arange(H))
    wave = 128 + 60 * np.sin((x + 3 * number) / 12.0) + 40 * np.cos(y / 10.0)
    return np.repeat(np.clip(wave, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def written(path: Path, codec: str) -> Path:
    code = cv2.VideoWriter.fourcc(*codec)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, FPS, (W, H))
    if not writer.isOpened():
        pytest.skip(f"this OpenCV writes no {codec} in {path.suffix}")
    for number in range(COUNT):
        writer.write(picture(number))
    writer.release()
    return path


@pytest.mark.parametrize(("codec", "suffix"), CONTAINERS)
def test_containers_and_codecs_give_the_pictures_and_their_times(
    tmp_path: Path, codec: str, suffix: str
) -> None:
    path = written(tmp_path / f"a:clip{suffix}", codec)
    assert camera_reader(path) is VideoFile
    frames = [frame for frame in VideoFile(path).frames() if isinstance(frame, Frame)]
    assert len(frames) == COUNT
    for number, frame in enumerate(frames):
        assert np.abs(frame.image.astype(int) - picture(number)).mean() < 6.0
        assert frame.t_ns == pytest.approx(number * 1e9 / FPS, abs=2e6)


def flagged_as_interlaced(path: Path) -> Path:
    """The MPEG-2 video with progressive_frame cleared in every picture (ISO 13818-2, 6.2.3.1)."""
    data = bytearray(path.read_bytes())
    at = data.find(b"\x00\x00\x01\xb5")
    while at >= 0:
        if data[at + 4] >> 4 == 8:  # picture coding extension
            data[at + 8] &= 0x7F
        else:  # sequence extension: progressive_sequence
            data[at + 5] &= 0xF7
        at = data.find(b"\x00\x00\x01\xb5", at + 4)
    path.write_bytes(data)
    return path


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs FFmpeg's program")
@pytest.mark.parametrize("suffix", [".mpg", ".m2v"])
def test_interlaced_pictures_are_the_right_ones(tmp_path: Path, suffix: str) -> None:
    source = VideoFile(flagged_as_interlaced(written(tmp_path / f"clip{suffix}", "mpg2")))
    frames = [frame for frame in source.frames() if isinstance(frame, Frame)]
    assert len(frames) == COUNT
    for number, frame in enumerate(frames):
        assert np.abs(frame.image.astype(int) - picture(number)).mean() < 6.0
    assert any("deinterlaced by FFmpeg" in note for note in source.notes)


def test_interlaced_pictures_are_refused_without_a_decoder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = flagged_as_interlaced(written(tmp_path / "clip.mpg", "mpg2"))
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match=r"interlaced pictures.*install FFmpeg"):
        VideoFile(path)


def test_pictures_that_the_decoder_complains_about_cost_themselves(tmp_path: Path) -> None:
    path = written(tmp_path / "clip.avi", "mp4v")
    data = bytearray(path.read_bytes())
    middle = data.find(b"\x00\x00\x01\xb6") + 200  # in the first picture (ISO 14496-2)
    data[middle : middle + 100] = bytes(reversed(range(100)))
    path.write_bytes(data)
    source = VideoFile(path)
    gone = [frame for frame in source.frames() if not isinstance(frame, Frame)]
    assert [frame.index for frame in gone] == [0]
    assert "without errors" in gone[0].reason
    assert any("the first is clip.avi#0" in note for note in source.notes)


def test_pixels_that_are_not_square_become_square(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path / "clip.mp4", "mp4v")
    asked = video._property
    shape = {cv2.CAP_PROP_SAR_NUM: 4.0, cv2.CAP_PROP_SAR_DEN: 3.0}

    def stated(capture: Any, number: int) -> float:
        return shape.get(number) or asked(capture, number)

    monkeypatch.setattr(video, "_property", stated)
    save_camera(guess_camera(W, H), tmp_path / "camera.yaml")
    source = VideoFile(path)
    (first, *_) = source.frames()
    assert isinstance(first, Frame)
    assert first.image.shape == (H, W * 4 // 3, 3)
    assert "not square" in source.notes[0]
    assert source.camera is not None
    assert source.camera.fx == pytest.approx(guess_camera(W, H).fx * 4 / 3)
    assert source.camera.fy == guess_camera(W, H).fy


def test_the_log_is_heard_only_while_it_is_entered() -> None:
    with DecoderLog() as log:
        assert log.errors() == 0
        assert not log.refused()
