"""The last net of the command line: every failure of a command is one sentence and an exit code.

1: the input or the machine, and what to do about it. 2: a wrong argument. 70: a mistake in
AquaFlow, reported as such; its traceback is kept in a file for the developers.
"""

from __future__ import annotations

import os
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from aquaflow import __version__
from aquaflow.base.errors import (
    AquaFlowError,
    ArgumentError,
    InputError,
    is_out_of_memory,
    printable,
    printable_text,
)

DEBUG = "AQUAFLOW_DEBUG"
"""Environment variable: set to anything, tracebacks go to stderr."""

FAILED = 1
"""Exit status after an error."""
MISUSED = 2
"""After a wrong argument, as of Typer's own checks."""
OUR_MISTAKE = 70
"""EX_SOFTWARE of sysexits.h."""
INTERRUPTED = 130
"""As a shell reports an end by Ctrl-C."""
STOPPED = "stopped; what was written so far stays where it is, and the same command begins anew"
"""The last line of a command that Ctrl-C ended."""


@contextmanager
def one_sentence() -> Iterator[None]:
    """Turn what the block raises into one sentence on stderr and an exit."""
    try:
        yield
    except Exception as error:
        if os.environ.get(DEBUG):
            traceback.print_exc()
        sentence, code = said_of(error)
        _end(sentence, code)
    except KeyboardInterrupt:
        _end(STOPPED, INTERRUPTED)
    except SystemExit as ended:
        if ended.code == INTERRUPTED:  # Typer exits so on Ctrl-C, and says nothing
            _end(STOPPED, INTERRUPTED)
        raise


def said_of(error: Exception) -> tuple[str, int]:
    """What the user reads of ``error``, and the exit code."""
    if isinstance(error, AquaFlowError):
        return str(error), MISUSED if isinstance(error, ArgumentError) else FAILED
    if isinstance(error, BrokenPipeError):
        return "whatever read the output has gone", FAILED
    if isinstance(error, OSError) and error.strerror:
        what = "a file or device" if error.filename is None else str(error.filename)
        return (
            f"cannot use {what}: {error.strerror}; check that it is there, that you may use it, "
            "and that there is room on the disk",
            FAILED,
        )
    if is_out_of_memory(error):
        return "out of memory; give smaller pictures with --width, or fewer of them", FAILED
    return _ours(error), OUR_MISTAKE


def _ours(error: Exception) -> str:
    """A bug: which, where it can be read, and what to do."""
    where = traceback.extract_tb(error.__traceback__)[-1:]
    place = "".join(f" in {Path(frame.filename).name} line {frame.lineno}" for frame in where)
    return (
        f"a mistake in AquaFlow itself ({type(error).__name__}{place}), not in what you gave it; "
        f"please report it with {_keep_traceback(error)}"
    )


def _keep_traceback(error: Exception) -> str:
    """The file that holds the traceback of the last mistake; only its owner may read it."""
    text = f"aquaflow {__version__}, Python {sys.version}\n{' '.join(sys.argv)}\n"
    text += "".join(traceback.format_exception(error))
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    for folder in (state / "aquaflow", Path(tempfile.gettempdir())):
        path = folder / f"aquaflow-mistake-{os.getuid()}.txt"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)  # also where it is a link
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "w", encoding="utf-8", errors="backslashreplace") as file:
                file.write(text)
        except OSError:
            continue
        return str(path)
    return f"what {DEBUG}=1 prints"


def _end(sentence: str, code: int) -> None:
    print(f"aquaflow: {printable(' '.join(sentence.split()))}", file=sys.stderr)
    sys.exit(code)


def refuse_unreadable(arguments: Sequence[str]) -> None:
    """Names on the command line must be text: neither OpenCV nor a report can take others, and a
    terminal obeys control characters.

    Raises:
        InputError: an argument is not in the encoding of the system, or holds what is no text.
    """
    for argument in arguments:
        try:
            argument.encode("utf-8")
        except UnicodeEncodeError as error:
            raise InputError(
                f"the name '{printable(argument)}' is not UTF-8; rename the file or folder"
            ) from error
        if printable_text(argument) != argument:
            raise InputError(
                f"the name '{printable(argument)}' holds control characters; rename the file or "
                "folder"
            )


def print_anything(streams: Sequence[TextIO]) -> None:
    """Let ``streams`` show what their encoding has no letter for, rather than fail."""
    for stream in streams:
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")
