"""Computations with pauses: generators that yield every few milliseconds, so that no frame waits
for the whole of them."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

Result = TypeVar("Result")

PICTURES_AT_ONCE = 4
"""Pictures worked on between two pauses: each takes 2 to 5 ms."""


def run_to_end(steps: Generator[None, None, Result]) -> Result:
    """What a computation with pauses ends with, its pauses left out."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: Result = end.value
            return result
