"""Which recordings a batch is of: those in a folder, at a URL, or named in a list."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from aquaflow.base.errors import AquaFlowError, InputError, printable, reason_of
from aquaflow.lab.batch.object_store import ObjectStore, StoredObject, is_url
from aquaflow.recordings.video import VideoFile
from aquaflow.sources import camera_reader

ANY_FOLDER = 1
"""Specificity of the reader that takes every folder for one of pictures."""
NO_RECORDINGS = (".txt", ".yaml", ".yml", ".json", ".csv", ".md", ".srt", ".tlog", ".log")
"""Suffixes of what lies beside recordings in an object store: camera files, tables, logs."""
DEEPEST = 8
"""Folders in folders that are looked into; a season has site, vehicle, day and dive."""


@dataclass(frozen=True)
class Recording:
    """A recording to be mapped."""

    name: str
    """Of its dive, unlike any other's."""
    source: str
    """Path or URL."""
    size_bytes: int


def find_recordings(dives: str) -> list[Recording]:
    """The recordings in the folder, at the URL or in the list file ``dives``, by name.

    Raises:
        InputError: there is none, two of them would get one name, or a line of the list names
            nothing.
    """
    if is_url(dives):
        found = [(e.url, e.size_bytes) for e in ObjectStore(dives).entries() if _may_be(e)]
    elif Path(dives).is_dir():
        found = [(str(path), _size(path)) for path in _in_folder(Path(dives), DEEPEST)]
    else:
        found = [_of_line(line) for line in _lines(Path(dives))]
    if not found:
        raise InputError(f"{dives} holds no recordings; give a folder of them, or a list")
    names = _names([source for source, _ in found])
    made = [Recording(name, *each) for name, each in zip(names, found, strict=True)]
    return sorted(made, key=lambda recording: recording.name)


def _may_be(entry: StoredObject) -> bool:
    return entry.is_folder or PurePosixPath(entry.name).suffix.lower() not in NO_RECORDINGS


def _in_folder(folder: Path, depth: int) -> list[Path]:
    """Recordings in ``folder``; a folder that is none is looked into."""
    found: list[Path] = []
    try:
        inside = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise InputError(f"cannot read {folder}: {error.strerror}") from error
    for path in inside:
        if _is_recording(path):
            found.append(path)
        elif path.is_dir() and depth > 0:
            found += _in_folder(path, depth - 1)
    return found


def _is_recording(path: Path) -> bool:
    reader = camera_reader(path)
    if reader is VideoFile:
        return path.is_file()  # its folder is looked into: a dive has the name of its file
    if reader is None or not path.is_dir() or reader.specificity > ANY_FOLDER:
        return reader is not None
    try:  # every folder might be one of pictures
        reader.open(path).close()
    except (AquaFlowError, OSError):
        return False
    return True


def _lines(file: Path) -> list[str]:
    """Paths and URLs in a list file; paths are relative to its folder."""
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot read {file}: {reason_of(error)}; give a folder of recordings, or a text file "
            "with one on each line"
        ) from error
    lines = (line.strip() for line in text.splitlines())
    named = [line for line in lines if line and not line.startswith("#")]
    return [line if is_url(line) else str(file.parent / line) for line in named]


def _of_line(source: str) -> tuple[str, int]:
    if is_url(source):
        return source, ObjectStore(source).size_bytes()
    try:
        there = Path(source).exists()
    except (OSError, ValueError):
        there = False
    if not there:
        raise InputError(f"there is nothing at {printable(source)[:200]}, which the list names")
    return source, _size(Path(source))


def _size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    if not path.is_dir():
        return path.stat().st_size
    inside = (Path(root) / name for root, _, names in os.walk(path) for name in names)
    return sum(each.stat().st_size for each in inside if each.is_file())


def _names(sources: list[str]) -> list[str]:
    """A name for each: that of the file without its suffix; with the folder's before it where two
    would be alike."""
    parts = [PurePosixPath(source.rstrip("/")) for source in sources]
    short = [_printable(part.stem if part.stem else part.name) for part in parts]
    often = Counter(short)
    names = [
        name if often[name] == 1 else f"{_printable(part.parent.name)}_{_printable(part.name)}"
        for name, part in zip(short, parts, strict=True)
    ]
    for name, count in Counter(names).items():
        if count > 1:
            raise InputError(f"{count} recordings would all become the dive {name}; rename them")
    return names


def _printable(name: str) -> str:
    return printable(name).lstrip(".").replace("/", "_").replace("\\", "_") or "dive"
