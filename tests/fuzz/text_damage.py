"""Damage to text: a number, or a value somewhere in a tree of YAML or JSON, becomes another."""

from __future__ import annotations

import copy
import json
import re
from typing import Any

import yaml

SUFFIXES_OF_TREES = (".yaml", ".json")

NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")

HOSTILE_NUMBERS = (
    *("nan", ".nan", ".inf", "-.inf", "inf", "NaN", "Infinity", "1e999", "-1", "0", "-0.0"),
    *("1e-320", "1e18", "2147483648", "-9223372036854775809", "18446744073709551616"),
    *("9" * 400, "0x7fffffff", "1_000", "1:30", "", "true", "null", "~", "[]", "{}", "[[1]]"),
    *('"text"', "2026-01-01", "!!python/none", "*x", "\udcff", "٣"),
)
"""Text in the place of a number: of YAML, JSON, CSV, a log's line, or a header of an array."""


def with_number(content: bytes, at: float, token: str) -> bytes:
    """``content`` with the number at the share ``at`` of all its numbers replaced."""
    found = list(NUMBER.finditer(content))
    if not found:
        return content
    number = found[min(int(at * len(found)), len(found) - 1)]
    put_in = token.encode("utf-8", "surrogateescape")
    return content[: number.start()] + put_in + content[number.end() :]


def with_value(content: bytes, at: float, token: str) -> bytes:
    """A YAML or JSON tree with one value or key changed; other text gets a number changed."""
    try:
        tree = yaml.safe_load(content)
    except (yaml.YAMLError, ValueError, RecursionError):
        return with_number(content, at, token)
    places = list(_places(tree, ()))
    if not places:
        return content
    place = places[min(int(at * len(places)), len(places) - 1)]
    changed = _replaced(tree, place, _hostile(token))
    if content.lstrip()[:1] == b"{":
        return json.dumps(changed, default=str).encode()
    return yaml.safe_dump(changed).encode()


def _places(tree: Any, above: tuple[Any, ...]) -> list[tuple[Any, ...]]:
    """Paths of every value below ``tree``."""
    keys = list(tree) if isinstance(tree, dict) else range(len(tree)) if _is_list(tree) else []
    here = [(*above, key) for key in keys]
    return here + [place for key in keys for place in _places(tree[key], (*above, key))]


def _is_list(tree: Any) -> bool:
    return isinstance(tree, list)


def _replaced(tree: Any, place: tuple[Any, ...], value: Any) -> Any:
    result = copy.deepcopy(tree)
    inner = result
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return result


def _hostile(token: str) -> Any:
    """What a token stands for; text that YAML does not read is itself."""
    if token == "[[1]]":
        deep: Any = []
        for _ in range(60):
            deep = [deep]
        return deep
    try:
        return yaml.safe_load(token)
    except (yaml.YAMLError, ValueError):
        return token.encode("utf-8", "replace").decode()  # JSON and YAML hold no half characters
