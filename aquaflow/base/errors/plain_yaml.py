"""YAML from untrusted files: small, plain, finite, or refused in one sentence.

Every YAML file that AquaFlow reads comes through here. PyYAML's safe loader makes no objects of
foreign classes, but it follows a document that contains itself, a number of any length, and
aliases that multiply; validating or printing such a file ends in a traceback or never.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from aquaflow.base.errors import ConfigError, InputError, path_of_key, reason_of
from aquaflow.base.errors.regular_file import open_regular

MOST_BYTES = 1 << 20
"""The longest config that ships has 4 kB; PyYAML reads some 100 kB a second."""
DIRECTIVE = "%YAML"
"""How the YAML of OpenCV's FileStorage begins, in a form that PyYAML refuses."""
MOST_DEPTH = 32
"""Mappings and lists inside each other; the deepest setting lies in 6."""
MOST_VALUES = 100_000
"""Counted as often as aliases repeat them."""
MOST_INTEGER = 1 << 63
"""Seeds and times in nanoseconds have 64 bits."""


def read_mapping(path: Path, what: str, hint: str, inside: bool = False) -> dict[str, Any]:
    """The mapping that a YAML file holds; empty for an empty file.

    ``what`` it is and a ``hint`` what to give instead stand in the sentences. ``inside``: the file
    lies in a folder that others may have made, see :mod:`aquaflow.base.errors.regular_file`.

    Raises:
        InputError: the file cannot be read, or is not YAML.
        ConfigError: it holds something else than plain, finite ``key: value`` pairs.
    """
    try:
        with open_regular(path) if inside else path.open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise ConfigError(f"{path} is longer than {MOST_BYTES >> 20} MB; {hint}")
        text = data.decode("utf-8")
        if text.startswith(DIRECTIVE):  # its FileStorage writes a head and a tag that YAML has not
            text = text.partition("\n")[2].replace("!!opencv-matrix", "")
        value = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the {what} {path}: {reason_of(error)}; {hint}") from error
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path} is not YAML that can be read ({reason_of(error)}); {hint}") from (
            error
        )
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise ConfigError(f"{path} holds no key: value pairs; {hint}")
    problem = next(_problems(value), None)
    if problem is not None:
        raise ConfigError(f"{path}: {problem}; {hint}")
    return value


def _problems(root: dict[Any, Any]) -> Iterator[str]:
    """What is not plain and finite, as words that follow the file's name; stops at any depth."""
    waiting: list[tuple[tuple[str, ...], Any]] = [((), root)]
    count = 0
    while waiting:
        keys, value = waiting.pop()
        count += len(value) if isinstance(value, (dict, list)) else 0
        if count > MOST_VALUES:
            yield f"it has more than {MOST_VALUES} values"
            return
        if len(keys) > MOST_DEPTH:
            yield f"'{path_of_key(keys[:1])}' has more than {MOST_DEPTH} levels, or contains itself"
            return
        if isinstance(value, dict):
            if not all(isinstance(key, str) for key in value):
                yield f"a key{_under(keys)} is not text"
                return
            waiting += [((*keys, key), each) for key, each in value.items()]
        elif isinstance(value, list):
            waiting += [((*keys, str(i)), each) for i, each in enumerate(value)]
        elif (said := _unusable(value)) is not None:
            yield f"'{path_of_key(keys)}' {said}"


def _under(keys: tuple[str, ...]) -> str:
    return f" under '{path_of_key(keys)}'" if keys else ""


def _unusable(value: Any) -> str | None:
    """Why a value can be no setting; None if it can."""
    if isinstance(value, int):
        return None if abs(value) <= MOST_INTEGER else "is too large a number"
    if isinstance(value, float):
        return None if math.isfinite(value) else "is not a finite number"
    if isinstance(value, str):
        return None if value.isascii() or _is_unicode(value) else "is not Unicode text"
    return None if value is None else "is neither text nor a number; put it into quotes"


def _is_unicode(text: str) -> bool:
    """False for half of a surrogate pair, which no file name and no terminal takes."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
