"""The labels of an image, read from its Dockerfile by Docker's rules.

https://docs.docker.com/reference/dockerfile: a backslash at a line's end goes on, lines that begin
with # in between are left out; a LABEL has key=value words, in which single quotes keep everything
as it is, double quotes keep all but variables and escapes, and $NAME is an ARG of the same stage.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

CONTINUED = re.compile(r"\\[ \t]*$")
PIECE = re.compile(
    r"""'(?P<plain>[^']*)'|"(?P<double>(?:\\.|[^"\\])*)"|(?P<bare>\\.|[^\s'"\\]+)""", re.DOTALL
)
VARIABLE = re.compile(r"\$(?:\{(\w+)\}|(\w+))")


def instructions(text: str) -> list[tuple[str, str]]:
    """Name and argument of each, with its lines joined."""
    found, started = [], ""
    for line in text.splitlines():
        if line.lstrip().startswith("#") or (not line.strip() and not started):
            continue
        goes_on = CONTINUED.search(line) is not None
        started += CONTINUED.sub("", line)
        if not goes_on:
            name, _, argument = started.strip().partition(" ")
            found.append((name.upper(), argument.strip()))
            started = ""
    assert not started, "the last line goes on"
    return found


def labels_of(text: str, build_args: Mapping[str, str] | None = None) -> dict[str, str]:
    """The labels of the last stage; ``build_args`` as given to ``docker build``."""
    labels: dict[str, str] = {}
    variables: dict[str, str] = {}
    for name, argument in instructions(text):
        if name == "FROM":
            labels, variables = {}, {}
        elif name == "ARG":
            key, _, default = argument.partition("=")
            variables[key] = (build_args or {}).get(key, default)
        elif name == "LABEL":
            for word in _words(argument, variables):
                key, _, value = word.partition("=")
                labels[key] = value
    return labels


def _words(argument: str, variables: Mapping[str, str]) -> list[str]:
    """Split at blanks outside quotes; every quote must be closed."""
    words, at = [""], 0
    while at < len(argument):
        if argument[at].isspace():
            words.append("")
            at += 1
            continue
        piece = PIECE.match(argument, at)
        assert piece is not None, f"an open quote in {argument[at:]!r}"
        words[-1] += _value(piece, variables)
        at = piece.end()
    return [word for word in words if word]


def _value(piece: re.Match[str], variables: Mapping[str, str]) -> str:
    if piece["plain"] is not None:
        return piece["plain"]
    text = piece["double"] if piece["double"] is not None else piece["bare"]
    expanded = VARIABLE.sub(lambda found: variables[found[1] or found[2]], text)
    return re.sub(r"\\(.)", r"\1", expanded)
