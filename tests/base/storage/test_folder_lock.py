"""One process writes to a folder; however it ends, the next one may."""

from __future__ import annotations

import errno
import fcntl
import subprocess
import sys
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.storage.whole_folder import FolderLock, is_held

HOLDER = """
import sys, time
from pathlib import Path
from aquaflow.base.storage.whole_folder import FolderLock
lock = FolderLock(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(600)
"""


def test_a_folder_is_held_until_its_process_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        assert is_held(tmp_path)
        with pytest.raises(InputError, match="held by a running aquaflow"):
            FolderLock(tmp_path)
        holder.kill()
    assert not is_held(tmp_path)
    lock = FolderLock(tmp_path)
    lock.release()
    lock.release()
    assert not is_held(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_without_locks_refuses_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unknown(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unknown)
    FolderLock(tmp_path)
    assert not is_held(tmp_path)


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot open the folder"):
        FolderLock(tmp_path / "nowhere")
    assert not is_held(tmp_path / "nowhere")
