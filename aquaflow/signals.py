"""Ending a long run by Ctrl-C, or by systemd's SIGTERM, instead of breaking it off."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from threading import Event


@contextlib.contextmanager
def until_told(stopping: Event) -> Iterator[None]:
    """Either signal sets ``stopping``; afterwards they mean what they did before."""
    asked = (signal.SIGINT, signal.SIGTERM)
    before: list[Callable[..., object] | int | None] = []
    with contextlib.suppress(ValueError):  # not in the main thread: somebody else listens
        before = [signal.signal(each, lambda *_: stopping.set()) for each in asked]
    try:
        yield
    finally:
        for each, handler in zip(asked, before, strict=False):
            signal.signal(each, handler)
