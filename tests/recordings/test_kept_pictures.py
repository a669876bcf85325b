"""Small pictures of a dive: one a second, never more bytes than the dive may spend."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.geometry.camera import guess_camera
from aquaflow.recordings.kept_pictures import FOLDER, KeptPictures, PictureThread, kept_pictures
from aquaflow.types import Frame

RATE = 4


def frame(index: int, size: tuple[int, int] = (640, 480)) -> Frame:
    """Of four a second."""
    width, height = size
    image = np.random.default_rng(index).integers(0, 255, (height, width, 3), np.uint8)
    t_ns = index * 10**9 // RATE
    return Frame(index, t_ns, t_ns, image, guess_camera(width, height))


def read(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture


def test_one_picture_a_second_is_kept_small(tmp_path: Path) -> None:
    pictures = KeptPictures(tmp_path, 1e9)
    for index in range(3 * RATE):
        pictures.offer(frame(index))
    kept = kept_pictures(tmp_path)
    assert list(kept) == [0, 4, 8]
    assert pictures.paths == kept
    assert read(kept[4]).shape == (360, 480, 3)


@pytest.mark.parametrize(("size", "kept"), [((200, 100), (100, 200)), ((300, 960), (480, 150))])
def test_a_small_picture_stays_and_a_tall_one_is_fitted(
    tmp_path: Path, size: tuple[int, int], kept: tuple[int, int]
) -> None:
    KeptPictures(tmp_path, 1e9).offer(frame(0, size))
    assert read(kept_pictures(tmp_path)[0]).shape[:2] == kept


def test_a_long_dive_keeps_fewer_pictures_that_span_it_all(tmp_path: Path) -> None:
    pictures = KeptPictures(tmp_path, 1e9)
    pictures.offer(frame(0, (64, 48)))
    most = 10.5 * pictures.taken
    pictures = KeptPictures(tmp_path, most)
    for index in range(1, 100 * RATE):
        pictures.offer(frame(index, (64, 48)))
    kept = list(kept_pictures(tmp_path))
    assert sum(path.stat().st_size for path in kept_pictures(tmp_path).values()) <= most
    assert 5 <= len(kept) <= 10
    assert kept[0] == 0
    assert kept[-1] >= 80 * RATE
    apart = np.diff(kept)
    assert apart.max() <= 2 * apart.min()


def test_a_dive_that_goes_on_counts_what_it_kept_before(tmp_path: Path) -> None:
    KeptPictures(tmp_path, 1e9).offer(frame(0))
    (tmp_path / FOLDER / "mine.jpg").write_bytes(b"x" * 100)
    again = KeptPictures(tmp_path, 1e9)
    assert again.taken == kept_pictures(tmp_path)[0].stat().st_size
    again.offer(frame(40))
    assert list(again.paths) == [0, 40]


def test_a_picture_that_cannot_be_written_is_said_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / FOLDER).write_text("in the way")
    with pytest.raises(InputError, match="cannot make"):
        KeptPictures(tmp_path, 1e9).offer(frame(0))
    assert kept_pictures(tmp_path) == {}


def test_the_thread_of_a_live_dive_writes_what_it_was_given(tmp_path: Path) -> None:
    pictures = KeptPictures(tmp_path, 1e9)
    thread = PictureThread(pictures, Failures())
    thread.offer(frame(0))
    thread.close()
    assert list(pictures.paths) == [0]
    assert "pictures" not in {each.name for each in threading.enumerate()}


def test_a_full_disk_is_left_to_what_matters_more(tmp_path: Path) -> None:
    pictures = KeptPictures(tmp_path, 1e9)
    thread = PictureThread(pictures, Failures(), has_room=lambda: False)
    thread.offer(frame(0))
    thread.close()
    assert pictures.paths == {}
