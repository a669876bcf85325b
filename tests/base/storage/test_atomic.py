"""Writing: nothing through a link, and nothing stays behind of what was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.storage import atomic
from aquaflow.base.storage.archive import write_arrays
from aquaflow.base.storage.atomic import (
    atomic_write,
    fresh_file,
    is_part,
    make_subfolder,
    open_to_append,
)

KILLED = """
import os, sys, time
from pathlib import Path
from aquaflow.base.storage.atomic import atomic_write
with atomic_write(Path(sys.argv[1]) / "a") as stream:
    stream.write(b"half")
    stream.flush()
    print("writing", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    path = tmp_path / "outside"
    path.write_bytes(b"theirs")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "folder"
    path.mkdir()
    return path


def test_a_link_under_the_final_name_is_replaced_and_not_followed(
    folder: Path, outside: Path
) -> None:
    (folder / "a").symlink_to(outside)
    with atomic_write(folder / "a") as stream:
        stream.write(b"ours")
    assert outside.read_bytes() == b"theirs"
    assert not (folder / "a").is_symlink()
    assert (folder / "a").read_bytes() == b"ours"


def test_a_link_under_any_name_of_the_past_is_not_followed(folder: Path, outside: Path) -> None:
    for name in (".a.part", ".a.mp4.part", ".a.part.mp4", "a.part"):
        (folder / name).symlink_to(outside)
    with atomic_write(folder / "a") as stream:
        stream.write(b"ours")
    with fresh_file(folder / "a.mp4") as part:
        part.write_bytes(b"ours")
    write_arrays(folder / "a", {})
    assert outside.read_bytes() == b"theirs"


def test_names_are_not_foreseen(folder: Path) -> None:
    names = set()
    for _ in range(2):
        with atomic_write(folder / "a"):
            names.update(path.name for path in folder.iterdir() if is_part(path))
    assert len(names) == 2


def test_what_fails_leaves_the_earlier_file_and_nothing_else(folder: Path) -> None:
    (folder / "a").write_bytes(b"earlier")

    def fails() -> None:
        with atomic_write(folder / "a") as stream:
            stream.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fails()
    assert [path.name for path in folder.iterdir()] == ["a"]
    assert (folder / "a").read_bytes() == b"earlier"


@pytest.mark.timeout(300)
def test_the_next_process_removes_what_a_killed_one_left_but_not_what_is_being_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writers = [
        subprocess.Popen([sys.executable, "-c", KILLED, folder], stdout=subprocess.PIPE)
        for _ in range(2)
    ]
    try:
        for writer in writers:
            assert writer.stdout is not None
            writer.stdout.readline()
        assert len([path for path in folder.iterdir() if is_part(path)]) == 2
        os.kill(writers[0].pid, signal.SIGKILL)
        writers[0].wait()
        monkeypatch.setattr(atomic, "_CLEARED", set())
        with atomic_write(folder / "b") as stream:
            stream.write(b"ours")
        assert len([path for path in folder.iterdir() if is_part(path)]) == 1
    finally:
        for writer in writers:
            writer.kill()
            writer.communicate()


def test_nothing_is_appended_to_the_target_of_a_link(folder: Path, outside: Path) -> None:
    (folder / "log.jsonl").symlink_to(outside)
    with pytest.raises(OSError, match="link"):
        open_to_append(folder / "log.jsonl")
    assert outside.read_bytes() == b"theirs"


def test_a_linked_subfolder_is_refused(folder: Path, tmp_path: Path) -> None:
    (folder / "pictures").symlink_to(tmp_path)
    with pytest.raises(OSError, match="link"):
        make_subfolder(folder / "pictures")


def test_a_folder_that_is_not_there_is_one_sentence(folder: Path) -> None:
    with pytest.raises(InputError, match="cannot write"), atomic_write(folder / "b" / "a"):
        pass


def test_the_users_own_link_to_a_folder_is_followed(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(folder)
    with atomic_write(tmp_path / "link" / "a") as stream:
        stream.write(b"ours")
    assert (folder / "a").read_bytes() == b"ours"
