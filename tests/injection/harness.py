"""Dives with the watch in place: once to count, and once for each fault."""

from __future__ import annotations

import importlib
import io
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from . import rewriting
from .child import Ended, forked
from .dives import Dive
from .watch import Found, Moment, Site, Strike, Watch

REPORT = "aquaflow/survey/report/"
"""Our files that draw with matplotlib, which takes a third of a tiny dive's time."""

WATCH = Watch()
"""The one of this process; a fork has its own copy."""


@dataclass(frozen=True)
class Injected:
    """A dive with a fault in it."""

    dive: Dive
    strike: Strike
    ended: Ended
    met: Moment | None
    """Where the fault met the dive; None if it never came to that call."""
    folder: Path


def install() -> None:
    """Once in a process, before anything of ours is imported."""
    rewriting.install(WATCH.called, WATCH.operated)


def counted(dive: Dive, recordings: Path, folder: Path) -> tuple[Ended, dict[Site, Found]]:
    """A whole dive without a fault, and every site that it reached.

    The modules that it loaded are then loaded here, so that later forks need not.
    """

    def work(told: dict[str, Any], save: Callable[[], None]) -> None:
        try:
            _run(dive, recordings, folder)
        finally:
            WATCH.active = False
            told["modules"] = sorted(sys.modules)
            told["found"] = [[asdict(site), asdict(what)] for site, what in WATCH.found.items()]

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    ended = forked(work, folder)
    for name in ended.told.get("modules", []):
        if name.partition(".")[0] in (*rewriting.OWN, "cv2", "torch", "scipy", "matplotlib"):
            try:
                importlib.import_module(name)
            except ImportError:  # some names are aliases that only their package makes
                continue
    found = {Site(**site): Found(**what) for site, what in ended.told.get("found", [])}
    return ended, found


def injected(dive: Dive, strike: Strike, recordings: Path) -> Injected:
    """A dive with one fault; its folder is the caller's to remove."""
    folder = Path(tempfile.mkdtemp(prefix="injection-"))

    def work(told: dict[str, Any], save: Callable[[], None]) -> None:
        def note(moment: Moment) -> None:
            told["met"] = asdict(moment)
            save()

        WATCH.planned, WATCH.on_strike = strike, note
        _run(dive, recordings, folder)

    ended = forked(work, folder)
    met = ended.told.get("met")
    return Injected(dive, strike, ended, None if met is None else Moment(**met), folder)


def _run(dive: Dive, recordings: Path, folder: Path) -> None:
    from aquaflow.cli import main
    from aquaflow.dive.run import DiveRun

    os.environ["XDG_STATE_HOME"] = str(folder)  # where mistakes of ours are reported
    # A shell starts what runs in the background deaf to it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _note_phases(DiveRun)
    if WATCH.planned is not None and not WATCH.planned.site.file.startswith(REPORT):
        _draw_nothing()
    sys.argv = ["aquaflow", *dive.prepare(recordings, folder)]
    WATCH.active = True
    main()


def _note_phases(run: Any) -> None:
    """From the first frame on, the watch knows which it is; then, that the end has begun."""
    take, finish = run.frame, run.finish

    def frame(self: Any, frame: Any) -> Any:
        WATCH.now = Moment("frames", frame.index)
        return take(self, frame)

    def at_the_end(self: Any, *args: Any, **keywords: Any) -> Any:
        WATCH.now = Moment("end", WATCH.now.frame)
        return finish(self, *args, **keywords)

    run.frame, run.finish = frame, at_the_end


def _draw_nothing() -> None:
    """Figures come out empty: for faults elsewhere, what they show does not matter."""
    from matplotlib.figure import Figure

    def savefig(self: Figure, file: IO[Any], **options: Any) -> None:
        empty = '<svg xmlns="http://www.w3.org/2000/svg"></svg>'
        file.write(empty if isinstance(file, io.TextIOBase) else empty.encode())

    Figure.savefig = savefig  # type: ignore[method-assign, assignment]
