"""Video files: whole or not there, at their own times."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.survey.video.encoder import VideoEncoder, video_file
from aquaflow.survey.video.overlay import Timeline, usual_fps
from tests.survey.video.player import stated_times

Picture = npt.NDArray[np.uint8]


def grey(level: int, width: int = 64, height: int = 48) -> Picture:
    return np.full((height, width, 3), level, np.uint8)


def levels(path: Path) -> list[int]:
    """Mean of each picture, rounded to tens."""
    reader, found = cv2.VideoCapture(str(path)), []
    while (read := reader.read())[0]:
        found.append(round(float(read[1].mean()) / 10.0) * 10)
    return found


def leftovers(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()]


def test_pictures_come_back_in_order_at_the_rate_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with video_file(path, 12.5) as file:
        for level in (20, 120, 220):
            file.add(grey(level))
    assert levels(path) == [20, 120, 220]
    assert stated_times(path) == pytest.approx([0.0, 0.08, 0.16], abs=1e-3)


def test_a_rate_of_television_is_kept_for_an_hour(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with video_file(path, 30_000 / 1001) as file:
        for _ in range(3):
            file.add(grey(90))
    assert stated_times(path)[2] * 1001 / 30_000 / (2 * (1001 / 30_000) ** 2) == pytest.approx(
        1.0, rel=0.05 / 3600
    )


def test_a_picture_with_odd_sides_gets_a_last_row_and_column_twice(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with video_file(path, 5.0) as file:
        file.add(grey(100, 65, 49))
    reader = cv2.VideoCapture(str(path))
    assert reader.get(cv2.CAP_PROP_FRAME_WIDTH) == 66
    assert reader.get(cv2.CAP_PROP_FRAME_HEIGHT) == 50


def test_the_same_pictures_give_the_same_bytes(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    pictures = random.integers(0, 256, (4, 48, 64, 3), dtype=np.uint8)
    for name in ("a.mp4", "b.mp4"):
        with video_file(tmp_path / name, 25.0) as file:
            for picture in pictures:
                file.add(picture)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


@pytest.mark.parametrize("raised", [KeyboardInterrupt, InputError])
def test_what_is_interrupted_leaves_no_file(tmp_path: Path, raised: type[BaseException]) -> None:
    def interrupted() -> None:
        with video_file(tmp_path / "a.mp4", 25.0) as file:
            file.add(grey(1))
            (part,) = leftovers(tmp_path)
            assert part.endswith(".part.mp4")
            raise raised

    with pytest.raises(raised):
        interrupted()
    assert leftovers(tmp_path) == []


def test_an_interrupted_run_leaves_an_earlier_video_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"earlier")

    def interrupted() -> None:
        with video_file(path, 25.0) as file:
            file.add(grey(1))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_bytes() == b"earlier"


def test_a_file_that_lost_pictures_is_refused(tmp_path: Path) -> None:
    part = tmp_path / "part.mp4"
    file = VideoEncoder(part, 25.0)
    for level in range(10):
        file.add(grey(level * 20))
    file.abandon()
    part.write_bytes(part.read_bytes()[:200])  # as a full disk leaves it
    with pytest.raises(InputError, match="of 10 pictures"):
        file.finish()


def test_a_video_without_a_picture_is_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no picture"), video_file(tmp_path / "a.mp4", 25.0):
        pass
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("name", ["a.avi", "a", "missing/a.mp4"])
def test_a_name_that_cannot_be_written_is_one_sentence(tmp_path: Path, name: str) -> None:
    with pytest.raises(AquaFlowError, match="a"), video_file(tmp_path / name, 25.0):
        pytest.fail("began to write")


def test_a_picture_of_another_size_is_refused(tmp_path: Path) -> None:
    def mixed() -> None:
        with video_file(tmp_path / "a.mp4", 25.0) as file:
            file.add(grey(1))
            file.add(grey(1, 32, 32))

    with pytest.raises(ValueError, match="64, 48"):
        mixed()


def test_pictures_are_shown_until_the_next_ones_time(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with video_file(path, 10.0) as file:
        line = Timeline(file, 10.0)
        for t_s, level in ((5.0, 20), (5.11, 60), (5.4, 100), (5.42, 140), (5.5, 180)):
            line.show(t_s, grey(level))
        line.end()
    # 5.42 falls into the interval of 5.4 and takes its place.
    assert levels(path) == [20, 60, 60, 60, 140, 180]


def test_the_rate_of_a_recording_is_found_although_frames_were_left_out() -> None:
    indices = np.array([0, 4, 8, 16, 20])
    assert usual_fps(indices / 29.97, indices) == pytest.approx(29.97)
    assert usual_fps(np.array([3.0]), np.array([0])) == 1.0
