"""Sets damaged files of a dive aside: nothing is deleted or mixed with newly written files.

``set-aside-1/``, ``set-aside-2/``, ... in the dive's folder, one for each start that found damage,
hold the files under the names that they had in the dive; ``why.txt`` says what is wrong with each.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import open_regular
from aquaflow.base.storage.atomic import atomic_write, open_to_append

WHY = "why.txt"
"""The file with the reason for each file set aside."""


class SetAside:
    """Makes its folder with the first file."""

    def __init__(self, dive: Path) -> None:
        self._dive = dive
        self._folder: Path | None = None

    def move(self, path: Path, why: str) -> None:
        """Move a file out of the dive.

        Raises:
            InputError: it cannot be moved.
        """
        try:
            path.replace(self._place(path, why))
        except OSError as error:
            raise _refusal(path, error) from error

    def copy(self, path: Path, why: str) -> None:
        """Keep a file as it is now, if it is there: it will be written anew.

        Raises:
            InputError: it cannot be copied.
        """
        if not path.is_file():
            return
        try:
            depth = len(path.relative_to(self._dive).parts) - 1
            with open_regular(path, depth) as stream, atomic_write(self._place(path, why)) as copy:
                shutil.copyfileobj(stream, copy)
        except OSError as error:
            raise _refusal(path, error) from error

    def _place(self, path: Path, why: str) -> Path:
        if self._folder is None:
            count = 1
            while (self._dive / f"set-aside-{count}").exists():
                count += 1
            self._folder = self._dive / f"set-aside-{count}"
        name = path.relative_to(self._dive)
        place = self._folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        with open_to_append(self._folder / WHY) as stream:
            stream.write(f"{name}: {why}\n".encode())
        return place


def _refusal(path: Path, error: OSError) -> InputError:
    reason = error.strerror or str(error)
    return InputError(f"cannot set {path} aside: {reason}; give the dive's folder room and rights")
