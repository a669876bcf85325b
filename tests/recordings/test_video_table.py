"""Videos as people have them: containers and codecs, pixel shapes, interlaced, damaged."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.recordings.video import VideoFile
from aquaflow.recordings.video_decoder import DecoderLog
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


def test_pictures_that_the_decoder_complains_about_cost_themselves(tmp_path: Path) -> None:
    path = written(tmp_path / "clip.avi", "mp4v")
    data = bytearray(path.read_bytes())
    middle = data.find(b"\x00\x00\x01\xb6") + 200  # in the first picture (ISO 14496-2)
    data[middle : middle + 100] = bytes(reversed(range(100)))
    path.write_bytes(data)
    source = VideoFile(path)
    gone = [frame for frame in source.frames() if not isinstance(frame, Frame)]
    assert gone[0].index == 0
    assert "is damaged: " in gone[0].reason
    assert any(note.startswith("the first error in clip.avi: ") for note in source.notes)


def test_the_log_is_heard_only_while_it_is_entered() -> None:
    with DecoderLog() as log:
        assert log.complaints() == []
