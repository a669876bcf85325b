"""Folders that appear whole: also where files were there before, and where a process was killed."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.storage.whole_folder import MARK, WORK, whole_folder


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def write(folder: Path, content: str) -> None:
    (folder / "images").mkdir()
    (folder / "images" / "0.png").write_text(content)
    (folder / "model.bin").write_text(content)


def write_and_fail(folder: Path) -> None:
    write(folder, "new")
    raise OSError(28, "no room")


def test_a_folder_is_there_only_once_the_block_has_ended(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with whole_folder(out) as made:
        write(made, "new")
        assert not out.exists()
    assert names(tmp_path) == ["deep/out/images/0.png", "deep/out/model.bin"]


def test_what_fails_leaves_everything_as_it_was(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with whole_folder(out) as made:
        write(made, "old")
    with pytest.raises(InputError, match="no room"), whole_folder(out) as made:
        write_and_fail(made)
    assert names(tmp_path) == ["out/images/0.png", "out/model.bin"]
    assert (out / "model.bin").read_text() == "old"


def test_files_of_others_stay_and_ours_are_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    for content in ("old", "new"):
        with whole_folder(out) as made:
            write(made, content)
    assert names(out) == ["images/0.png", "mine.txt", "model.bin"]
    assert (out / "images" / "0.png").read_text() == "new"


def test_a_folder_into_which_the_moving_broke_off_is_marked_until_it_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "model.bin").write_text("old")
    replace = Path.replace

    def broken(self: Path, target: Path) -> Path:
        if self.name == "model.bin":
            raise OSError(5, "gone")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", broken)
    with pytest.raises(InputError, match="gone"), whole_folder(out) as made:
        write(made, "new")
    monkeypatch.undo()
    assert "Give the same command again" in (out / MARK).read_text()
    with whole_folder(out) as made:
        write(made, "new")
    assert names(out) == ["images/0.png", "model.bin"]


def test_what_a_killed_process_left_is_removed_and_others_folders_are_not(tmp_path: Path) -> None:
    for name in ("out.0a1b2c3d", "other.0a1b2c3d"):
        (tmp_path / f".{name}{WORK}").mkdir()
    with whole_folder(tmp_path / "out") as made:
        (made / "file").touch()
    assert [path.name for path in tmp_path.glob(".*")] == [f".other.0a1b2c3d{WORK}"]


def test_a_file_in_the_way_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(InputError, match="is no folder"), whole_folder(tmp_path / "out"):
        pass
