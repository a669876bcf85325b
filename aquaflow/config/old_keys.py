"""What became of keys that a config had in earlier releases; understood for one release."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from copy import deepcopy
from typing import Any

from aquaflow.config.stage import Stage, changed_in_the_lab

log = logging.getLogger(__name__)

CONSTANTS: dict[str, Any] = {}
"""Settings of before that are constants now, and their values."""
GONE: dict[str, str] = {}
"""Settings of before whose code went, and why."""
FROM_THE_LAB = "set `lab: true` in the file to keep it from the next release on"


def understood(model: type[Stage], data: Mapping[str, Any], origin: str) -> dict[str, Any]:
    """A user's ``data`` as ``model`` takes it: keys of before are taken out, and a logged sentence
    for each says what became of it, where the file wants another value than there is now."""
    current = without_old_keys(data, origin)
    if not current.get("lab"):
        for path in changed_in_the_lab(model, current):
            log.warning(
                "%s: '%s' is a switch of the lab now, no setting of a dive; it is used: %s",
                origin, path, FROM_THE_LAB,
            )  # fmt: skip
    return current


def without_old_keys(data: Mapping[str, Any], origin: str) -> dict[str, Any]:
    """``data`` without keys of before; a logged sentence for each whose value is not used."""
    current = deepcopy(dict(data))
    for path, value in _taken_out(current, CONSTANTS):
        if value != CONSTANTS[path]:
            log.warning(
                "%s: '%s' is a constant now, %s; the file's %s is not used",
                origin, path, CONSTANTS[path], value,
            )  # fmt: skip
    for path, _ in _taken_out(current, GONE):
        log.warning("%s: '%s' is no key any more and not used: %s", origin, path, GONE[path])
    return current


def _taken_out(data: dict[str, Any], paths: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Remove each of ``paths`` that is in ``data``; the path and its value."""
    for path in paths:
        *stages, key = path.split(".")
        below: Any = data
        for stage in stages:
            below = below.get(stage) if isinstance(below, dict) else None
        if isinstance(below, dict) and key in below:
            yield path, below.pop(key)
