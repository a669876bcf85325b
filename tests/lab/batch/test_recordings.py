"""Which recordings a batch finds, and what their dives are called."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.lab.batch.recordings import find_recordings


def test_videos_pictures_and_folders_of_them_are_found_and_logs_are_not(
    pictures: Path, tmp_path: Path
) -> None:
    season = tmp_path / "season"
    shutil.copytree(pictures, season / "monday" / "stills")
    (season / "monday" / "film.mp4").write_bytes(b"x" * 10)
    (season / "vehicle.tlog").write_bytes(b"x")
    (season / ".hidden.mp4").write_bytes(b"x")
    found = find_recordings(str(season))
    assert [each.name for each in found] == ["film", "stills"]
    assert found[0].size_bytes == 10


def test_recordings_of_one_name_get_that_of_their_folder_too(tmp_path: Path) -> None:
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "GX01.mp4").write_bytes(b"x")
    names = [each.name for each in find_recordings(str(tmp_path))]
    assert names == ["monday_GX01.mp4", "tuesday_GX01.mp4"]


def test_a_list_names_recordings_relative_to_itself(pictures: Path, tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("# a season\n\npictures\n")
    [found] = find_recordings(str(tmp_path / "list.txt"))
    assert found.source == str(pictures)


@pytest.mark.parametrize(
    ("content", "problem"),
    [("", "no recordings"), ("nothing.mp4\n", "nothing.mp4"), ("a/b.mp4\nc/a/b.mp4", "nothing")],
)
def test_a_list_of_nothing_is_refused(tmp_path: Path, content: str, problem: str) -> None:
    (tmp_path / "list.txt").write_text(content)
    with pytest.raises(InputError, match=problem):
        find_recordings(str(tmp_path / "list.txt"))


def test_two_recordings_that_would_become_one_dive_are_refused(
    pictures: Path, tmp_path: Path
) -> None:
    (tmp_path / "list.txt").write_text("pictures\npictures\n")
    with pytest.raises(InputError, match="rename them"):
        find_recordings(str(tmp_path / "list.txt"))
