"""What the commands share: groups, the --json option, progress bars, and a console for tables."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from typer.core import TyperGroup

from aquaflow.base.errors import ArgumentError, printable_text
from aquaflow.base.progress import WHOLE, Course

if TYPE_CHECKING:
    from rich.console import Console


class GroupWithDefault(TyperGroup):
    """A group whose own name is a command too: ``export DIVE`` beside ``export video DIVE``.

    The command that is called as the group is not one of its words; a word that is none of the
    others is its argument, and so a folder named "video" is given as ./video.
    """

    def __init__(self, *, name: str | None = None, commands: Any = None, **more: Any) -> None:
        others = dict(commands)
        self.default = others.pop(name)
        super().__init__(name=name, commands=others, **more)
        self.default.epilog = "\n\n".join(
            f"{name} {word}: {each.get_short_help_str(200)}" for word, each in others.items()
        )

    def make_context(
        self, info_name: str | None, args: list[str], parent: Any = None, **more: Any
    ) -> Any:
        """The context of a command that is named, else of the default, as if it stood alone."""
        if args and args[0] in self.commands:
            return super().make_context(info_name, args, parent, **more)
        return self.default.make_context(info_name, args, parent, **more)


Json = Annotated[bool, typer.Option("--json", help="Print machine-readable JSON.")]

WhiteBalanceOption = Annotated[
    str | None,
    typer.Option(
        help="Of colours without water: camera (as it saw what was nearest), neutral (the scene's "
        "light is grey), daylight (that at the dive's depth is, in its water), daylight:TYPE (in "
        "Jerlov's), or FRAME:X,Y, a pixel that is grey; else as the dive was mapped."
    ),
]

PRESETS = (
    "fast | balanced | accurate | small | onboard-gpu | paper | paper-strict; "
    "the last three never measured on a GPU"
)
"""Help of --preset; a test holds it to the presets that there are."""


NOT_MAPPED = "aquaflow.live.live_dive"
"""Logger of why nothing of a live dive could be mapped."""


def duration(value: float | None) -> float | None:
    """An option in seconds that a clock can wait for.

    Raises:
        typer.BadParameter: it is negative, not finite, or longer than any timer runs.
    """
    if value is not None and not 0.0 <= value <= threading.TIMEOUT_MAX:
        raise typer.BadParameter(f"give seconds from 0 to {threading.TIMEOUT_MAX:.0f}")
    return value


Choice = TypeVar("Choice", bound=str)


def one_of(choices: Sequence[Choice], value: str, option: str) -> Choice:
    """The value of an option that has to be one of ``choices``.

    Raises:
        ArgumentError: it is another.
    """
    for choice in choices:
        if choice == value:
            return choice
    raise ArgumentError(f"{option} is {value!r}; use one of {', '.join(choices)}")


Seconds = Annotated[float | None, typer.Option(callback=duration, help="Stop after this long.")]

InSite = Annotated[
    Path | None,
    typer.Option(
        "--in", metavar="SITE", help="Earlier dive, or site, in whose frame this one shall go on."
    ),
]


def checked_site(folder: Path, out: Path | None) -> Path:
    """The folder of ``--in``, refused before anything heavy begins.

    Raises:
        InputError: it is no dive in which places can be found again.
        ArgumentError: it is the one in ``--out``.
    """
    from aquaflow.tracking.base import base_of

    if out is not None and out.resolve() == folder.resolve():
        raise ArgumentError(f"--in and --out are both {folder}; a dive is never changed by another")
    base_of(folder)
    return folder


LOG_WIDTH = 200
"""Table width without a terminal: a log must neither cut nor fold numbers."""


LINE_S = 60.0
"""Between two lines of progress where there is no terminal."""


@contextmanager
def progress_bars(quiet: bool) -> Iterator[Any]:
    """A function (stage, done, total) that draws a bar for each stage on a terminal, and elsewhere,
    as in the journal of a service, says once a minute how far it is. What is left is that of
    ``WHOLE`` if the command knows it, else of the stage."""
    from rich.console import Console

    course, console = Course(), Console(stderr=True)
    if quiet:
        yield course.advance
    elif console.is_terminal:
        with _bars(course, console) as advance:
            yield advance
    else:
        with _lines(course):
            yield course.advance


@contextmanager
def _bars(course: Course, console: Console) -> Iterator[Any]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    text, left = TextColumn("{task.description:>8}"), TextColumn("{task.fields[left]}")
    with Progress(text, BarColumn(), MofNCompleteColumn(), left, console=console) as bars:
        tasks: dict[str, Any] = {}

        def advance(stage: str, done: int, total: int | None) -> None:
            if stage != WHOLE and course.stage in tasks:
                bars.update(tasks[course.stage], left="")
            course.advance(stage, done, total)
            if stage != WHOLE:
                if stage not in tasks:
                    tasks[stage] = bars.add_task(stage, total=total, left="")
                bars.update(tasks[stage], completed=done, total=total)
            if course.stage in tasks:
                bars.update(tasks[course.stage], left=course.left())

        yield advance


@contextmanager
def _lines(course: Course) -> Iterator[None]:
    ended = threading.Event()

    def tell() -> None:
        while not ended.wait(LINE_S):
            if course.stage:
                typer.echo(course.in_words(), err=True)

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()


def unit_in_words(metrics: Mapping[str, Any]) -> list[str]:
    """The unit of the dive's lengths, by its ``metrics.json``; no line without telemetry."""
    if metrics["unit"] == "m":
        sigma_pct = 100.0 * metrics["scale_sigma"]
        return [
            f"Lengths are metres, +- {sigma_pct:.2g} % (1 sigma), by {metrics['scale_source']}."
        ]
    if metrics["telemetry"]:
        return [f"Lengths are map units; metres: {metrics['scale_source']}."]
    return []


class _Sentence(logging.Formatter):
    """The message alone; a traceback is in the dive's log."""

    def format(self, record: logging.LogRecord) -> str:
        return printable_text(record.getMessage())


def live_on_stderr() -> None:
    """Print what happens to devices as it happens, and why a dive was not mapped: on a terminal,
    and in the journal of a service."""
    said = logging.StreamHandler()
    said.setFormatter(_Sentence())
    said.addFilter(
        lambda record: record.name == NOT_MAPPED or "source" in getattr(record, "fields", {})
    )
    logging.getLogger("aquaflow").addHandler(said)


def table_console() -> Console:
    """A console as wide as the terminal, or as the table where there is none."""
    from rich.console import Console

    console = Console()
    return console if console.is_terminal else Console(width=LOG_WIDTH)
