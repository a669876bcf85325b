"""Clean end of a long run on SIGINT (Ctrl-C) or SIGTERM (systemd)."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from threading import Event


@contextlib.contextmanager
def stop_on_signals(stopping: Event) -> Iterator[None]:
    """Either signal sets ``stopping``; the previous handlers are restored at the end."""
    asked = (signal.SIGINT, signal.SIGTERM)
    before: list[Callable[..., object] | int | None] = []
    with contextlib.suppress(ValueError):  # only the main thread may set handlers
        before = [signal.signal(each, lambda *_: stopping.set()) for each in asked]
    try:
        yield
    finally:
        for each, handler in zip(asked, before, strict=False):
            signal.signal(each, handler)
