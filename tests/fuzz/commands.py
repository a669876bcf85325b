"""The commands and their parameters, as typer declares them."""

from __future__ import annotations

import inspect
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from aquaflow.cli.console import GroupWithDefault

OUTPUTS = frozenset({"out", "readme", "csv"})
"""Parameters whose file or folder a command may write."""


@dataclass(frozen=True)
class Parameter:
    """One argument or option of a command."""

    name: str
    flags: tuple[str, ...]
    """``("--out",)``; for a switch with its opposite both; empty for an argument."""
    kind: type
    """bool, int, float, str, Path, or an Enum."""
    required: bool

    @property
    def is_output(self) -> bool:
        return self.name in OUTPUTS


@dataclass(frozen=True)
class Command:
    """A command without commands of its own."""

    words: tuple[str, ...]
    parameters: tuple[Parameter, ...]

    @property
    def name(self) -> str:
        return " ".join(self.words)

    @property
    def weight(self) -> int:
        """Share of the fuzzer's time: commands that read and write more are worth more."""
        return 1 + sum(parameter.kind is Path for parameter in self.parameters)


def all_commands() -> list[Command]:
    """Every command of ``aquaflow``, those of groups included."""
    from aquaflow.cli import app

    return list(_below(typer.main.get_command(app), ()))


def _below(command: Any, words: tuple[str, ...]) -> typing.Iterator[Command]:
    groups = getattr(command, "commands", None)
    if groups is None:
        kinds = typing.get_type_hints(inspect.unwrap(command.callback))
        yield Command(words, tuple(_parameter(p, kinds[p.name]) for p in command.params))
        return
    if isinstance(command, GroupWithDefault):
        yield from _below(command.default, words)
    for name, inner in groups.items():
        yield from _below(inner, (*words, name))


def _parameter(declared: Any, annotation: Any) -> Parameter:
    is_argument = declared.param_type_name == "argument"
    flags = () if is_argument else (*declared.opts, *declared.secondary_opts)
    return Parameter(declared.name, flags, _kind(annotation), declared.required)


def _kind(annotation: Any) -> type:
    """The type of one value: ``Path`` of ``list[Path] | None``."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType, list):
        (inner,) = (a for a in typing.get_args(annotation) if a is not type(None))
        return _kind(inner)
    assert isinstance(annotation, type)
    return annotation
