"""The errors a user can meet: one sentence each that says what, which input, what to do."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterable
from importlib import import_module
from typing import Any


class AquaFlowError(Exception):
    """Base of every error that the command line prints as one sentence."""


class InputError(AquaFlowError):
    """A file, folder or stream that cannot be used."""


class ConfigError(AquaFlowError):
    """A setting that is unknown or out of range, in a config or calibration file or an option."""


class ArgumentError(ConfigError):
    """An option's value, or options together, that no file could make right."""


class NotMappedError(AquaFlowError):
    """The input was read, but no map could be made of it."""


MAX_QUOTED = 160
"""Characters of another library's message that one of our sentences quotes."""


def first_line(error: BaseException) -> str:
    """The message of another library's error, short enough for a sentence; its kind if it
    has no message. For an error while reading a file use :func:`reason_of` instead."""
    return (str(error).splitlines() or [type(error).__name__])[0][:MAX_QUOTED]


class DamagedError(ValueError):
    """What a reader of ours found wrong with a file, in words that hold nothing of its content."""


FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""No room on the disk, in the user's share of it, or for a file of this size."""

_NO_MEMORY = (
    "can't allocate memory",
    "not enough memory",
    "failed to allocate",
    "insufficient mem",
)
"""How torch, OpenCV and onnxruntime word what is no MemoryError of theirs, in lower case."""


_DEVICE_FAILED = (
    "cuda error",
    "cuda out of memory",
    "cudnn error",
    "cublas_status",
    "cusolver error",
)
"""How torch words the failure of a GPU, in lower case; after most of them no call works."""


_DEVICE_FULL = (
    "cuda out of memory",
    "cuda error: out of memory",
    "cublas_status_alloc_failed",
)
"""How torch words that a GPU has no memory left; it works on."""


def is_out_of_memory(error: BaseException) -> bool:
    """True for a MemoryError, and for what libraries raise in its place."""
    if isinstance(error, MemoryError):
        return True
    return isinstance(error, Exception) and any(each in str(error).lower() for each in _NO_MEMORY)


def is_device_failure(error: BaseException | None) -> bool:
    """True for what torch raises when a GPU has no memory left, or is gone."""
    return _says(error, _DEVICE_FAILED)


def is_device_full(error: BaseException | None) -> bool:
    """True for what torch raises when a GPU has no memory left for a tensor."""
    return _says(error, _DEVICE_FULL)


def _says(error: BaseException | None, words: Iterable[str]) -> bool:
    """True if the error, or what caused it, has one of these in its message."""
    while error is not None:
        if any(each in str(error).lower() for each in words):
            return True
        error = error.__cause__
    return False


def is_full_disk(error: BaseException | None) -> bool:
    """True if the disk was full, also where the error is one of our own sentences."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in FULL_DISK:
            return True
        error = error.__cause__
    return False


_KINDS = {
    UnicodeError: "it is not text",
    RecursionError: "it is nested too deeply",
    MemoryError: "it needs more memory than there is",
}
"""What Python's own errors mean for a file."""
_NAME = re.compile(r"[A-Za-z_][\w-]{0,40}|\d{1,6}", re.ASCII)
"""What may be shown of a key: a name as ours are, or a place in a list."""
_POSITION = re.compile(r"\bline:? (\d+)(?:[ ,(]*col(?:umn)?:? (\d+))?", re.IGNORECASE)
"""Where a parser's message says that it stopped."""


_COMMANDS = re.compile(
    "[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u061c\\u200e\\u200f\\u202a-\\u202e\\u2066-\\u2069]"
)
"""Control characters but tab and line feed (ECMA-48), and those of bidirectional text (Unicode)."""


def reason_of(error: BaseException) -> str:
    """Why another library could not use a file, without a word of what the file holds.

    Parsers quote what they could not read, and AquaFlow may have been pointed at any file, by a
    user with more rights than the reader of the message: so only what the system said, the kind
    of the error and its position are passed on.
    """
    if isinstance(error, (AquaFlowError, DamagedError)):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    for kind, words in _KINDS.items():
        if isinstance(error, kind):
            return words
    found = _POSITION.search(str(error))
    if found is None:
        return _words(type(error).__name__)
    column = "" if found[2] is None else f", column {found[2]}"
    return f"{_words(type(error).__name__)} in line {found[1]}{column}"


def reason_or_key(error: BaseException) -> str:
    """As :func:`reason_of`, or which key is missing in what AquaFlow reads by name."""
    return f"key {error} is missing" if isinstance(error, KeyError) else reason_of(error)


def _words(name: str) -> str:
    """``BadZipFile`` as "bad zip file"."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name).lower()


def times(count: int) -> str:
    """How often, in words: ``once``, ``2 times``."""
    return "once" if count == 1 else f"{count} times"


def printable(name: str) -> str:
    r"""A file name to show: bytes that are not UTF-8 as ``\xe9``, a line break as ``\n``."""
    try:
        raw = name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:  # half a character from a file's text, which no name on disk has
        raw = name.encode("utf-8", "backslashreplace").decode("utf-8")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in raw)


def printable_text(text: str) -> str:
    r"""A text of several lines to show: other control characters, which a terminal obeys, and marks
    that turn the direction of writing as ``\x1b`` and ``\u202e``."""
    return _COMMANDS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def words_of(message: str) -> str:
    """pydantic's message on a key, as words that follow the key's name; names and values in it keep
    their case."""
    own = message.removeprefix("Value error, ")
    return message[:1].lower() + message[1:] if own == message else own


def path_of_key(parts: Iterable[object]) -> str:
    """Where a setting stands, as ``mapping.medium.enabled``; what is no name is left out, for a
    file that is no config may have anything before a colon."""
    return ".".join(str(part) if _NAME.fullmatch(str(part)) else "..." for part in parts)


# --------------------------------------------------------------------------------------------------
# Optional libraries: loaded when they are needed; an error of one sentence if missing.


def load(module: str, needed_by: str, extra: str = "telemetry") -> Any:
    """Import ``module``; typed Any, because most such libraries carry no types.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"{needed_by} needs the library {error.name or module}, which is not installed; "
            f"run `pip install 'aquaflow[{extra}]'`"
        ) from error
