"""Files that are whole or not there: a vehicle may lose its power while one is written."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import yaml

from aquaflow.base.errors import InputError


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A stream whose content becomes ``path`` when the block ends without an exception.

    Raises:
        InputError: the file cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    with becoming(path, part), part.open("wb") as stream:
        yield stream
        stream.flush()
        os.fsync(stream.fileno())


@contextlib.contextmanager
def becoming(path: Path, part: Path) -> Iterator[None]:
    """``part``, which the block writes to the disk, becomes ``path`` when it ends without an
    exception; else it is removed, and what was at ``path`` stays.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        yield
        part.replace(path)
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror or error}; give a folder with room that can be "
            "written to"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def write_json(path: Path, data: dict[str, Any]) -> None:
    """A JSON file, whole or not there; a number that is not finite is a mistake, not a result.

    Raises:
        InputError: the file cannot be written.
        ValueError: a number is not finite.
    """
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    with atomic_write(path) as stream:
        stream.write(text.encode("utf-8"))


def write_yaml(path: Path, data: dict[str, Any], comment: str = "") -> None:
    """Write a YAML file atomically, with its keys in the order of ``data``, after a ``comment`` of
    one line.

    Raises:
        InputError: the file cannot be written.
    """
    head = f"# {comment}\n" if comment else ""
    text = head + yaml.safe_dump(data, sort_keys=False, allow_unicode=False)
    with atomic_write(path) as stream:
        stream.write(text.encode("utf-8"))
