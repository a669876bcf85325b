"""Damage to files and folders: bytes flipped, cut, put in; numbers and values replaced."""

from __future__ import annotations

import contextlib
import io
import shutil
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .text_damage import SUFFIXES_OF_TREES, with_number, with_value

BROKEN_ZIP = (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError)
"""What zipfile raises for an archive that an earlier damage hit."""


@dataclass(frozen=True)
class Damage:
    """One change; places are shares of what is there, so that it fits any file."""

    kind: str
    file: float
    """Which file of a folder, from 0 to 1."""
    at: float
    """Where in the file, from 0 to 1."""
    size: int
    token: str
    """What takes a number's or a value's place."""


def apply_damage(path: Path, damage: Damage) -> None:
    """Change the file ``path``, or one file of the folder ``path``."""
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        if not files:
            return
        path = files[min(int(damage.file * len(files)), len(files) - 1)]
    # A file that an earlier damage made unreadable, a folder or a loop of links stays so.
    with contextlib.suppress(OSError):
        if damage.kind in OF_PATHS:
            OF_PATHS[damage.kind](path)
        else:
            path.write_bytes(_damaged(path, damage))


def _damaged(path: Path, damage: Damage) -> bytes:
    content = path.read_bytes()
    if damage.kind == "value" and path.suffix in SUFFIXES_OF_TREES:
        return with_value(content, damage.at, damage.token)
    if damage.kind == "member" and zipfile.is_zipfile(path):
        with contextlib.suppress(*BROKEN_ZIP):
            return _with_member(content, damage)
    if damage.kind in ("number", "value"):
        return with_number(content, damage.at, damage.token)
    return OF_BYTES.get(damage.kind, _flipped)(content, int(damage.at * len(content)), damage)


def _with_member(content: bytes, damage: Damage) -> bytes:
    """A zip file in which one member is damaged, with a checksum that is right."""
    result = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(result, "w") as new:
        names = old.namelist()
        chosen = names[min(int(damage.file * len(names)), len(names) - 1)]
        for name in names:
            member = old.read(name)
            if name == chosen and damage.token and damage.size % 2:
                member = with_number(member, damage.at, damage.token)
            elif name == chosen:
                member = _flipped(member, int(damage.at * len(member)), damage)
            new.writestr(name, member)
    return result.getvalue()


def _flipped(content: bytes, at: int, damage: Damage) -> bytes:
    changed = bytearray(content)
    for place in range(at, min(at + 1 + damage.size % 4, len(changed))):
        changed[place] ^= 1 << (damage.size % 8)
    return bytes(changed)


def _cut(content: bytes, at: int, _damage: Damage) -> bytes:
    return content[:at]


def _removed(content: bytes, at: int, damage: Damage) -> bytes:
    return content[:at] + content[at + damage.size :]


def _inserted(content: bytes, at: int, damage: Damage) -> bytes:
    return content[:at] + damage.token.encode("utf-8", "surrogateescape") + content[at:]


def _zeroed(content: bytes, at: int, damage: Damage) -> bytes:
    return content[:at] + bytes(len(content[at : at + damage.size])) + content[at + damage.size :]


def _swapped(content: bytes, at: int, _damage: Damage) -> bytes:
    return content[at:] + content[:at]


def _repeated(content: bytes, at: int, damage: Damage) -> bytes:
    return content[:at] + content[at : at + damage.size] * 3 + content[at + damage.size :]


def _made_empty(path: Path) -> None:
    path.write_bytes(b"")


def _made_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _made_unreadable(path: Path) -> None:
    path.chmod(0)


def _made_loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def _made_endless(path: Path) -> None:
    """As a file that another program keeps writing zeros to, up to what fits."""
    with path.open("r+b") as stream:
        stream.truncate(1 << 24)


def _doubled(path: Path) -> None:
    shutil.copy(path, path.with_name(f"{path.stem}-2{path.suffix}"))


OF_BYTES: dict[str, Callable[[bytes, int, Damage], bytes]] = {
    "flip": _flipped,
    "cut": _cut,
    "remove": _removed,
    "insert": _inserted,
    "zero": _zeroed,
    "swap": _swapped,
    "repeat": _repeated,
}
OF_PATHS: dict[str, Callable[[Path], None]] = {
    "gone": Path.unlink,
    "empty": _made_empty,
    "folder": _made_folder,
    "unreadable": _made_unreadable,
    "loop": _made_loop,
    "endless": _made_endless,
    "double": _doubled,
}
KINDS = ("value", "value", "number", "number", "member", *OF_BYTES, *OF_PATHS)
"""Twice what is most likely to pass a first check."""
