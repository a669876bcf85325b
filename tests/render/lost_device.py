"""A device of wgpu's that is lost, as drivers word it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from aquaflow.render.webgpu_device import Device


class LostError(Exception):
    """What a call of a lost device raises."""


def lose_after(monkeypatch: pytest.MonkeyPatch, calls: int, *names: str) -> Callable[[], int]:
    """Let the device be lost after so many calls of these methods, for good; returns what counts
    the calls so far."""
    count = 0

    def failing(whole: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            nonlocal count
            count += 1
            if count > calls:
                raise LostError("Parent device is lost\nand more words")
            return whole(*arguments, **named)

        return call

    for name in names:
        monkeypatch.setattr(Device, name, failing(getattr(Device, name)))
    return lambda: count
