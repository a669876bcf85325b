"""Clean end of a long run on SIGINT (Ctrl-C) or SIGTERM (systemd)."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from threading import Event

ASKED = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stop_on_signals(*stopping: Event, once: bool = False) -> Iterator[None]:
    """Either signal sets all of ``stopping``; with ``once``, the next one ends the process as it
    stands. The previous handlers are restored at the end."""

    def stop(*_: object) -> None:
        for event in stopping:
            event.set()
        for each in ASKED if once else ():
            signal.signal(each, signal.SIG_DFL)

    before: list[Callable[..., object] | int | None] = []
    with contextlib.suppress(ValueError):  # only the main thread may set handlers
        before = [signal.signal(each, stop) for each in ASKED]
    try:
        yield
    finally:
        for each, handler in zip(ASKED, before, strict=False):
            signal.signal(each, handler)
