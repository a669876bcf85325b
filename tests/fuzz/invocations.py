"""What to run: arguments drawn from a command's own parameters, and the files that they name."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from hypothesis import strategies as st

from .commands import Command, Parameter
from .damage import KINDS, Damage
from .text_damage import HOSTILE_NUMBERS
from .values import ABSURD_PATHS, FITTING, ONLY, QUICK, TEXTS, USUAL, numbers


@dataclass(frozen=True)
class Planted:
    """A copy of an exemplar in the folder where the command runs."""

    exemplar: str
    damages: tuple[Damage, ...]

    @property
    def name(self) -> str:
        return self.exemplar


@dataclass(frozen=True)
class Invocation:
    """One run of a command."""

    command: Command
    arguments: tuple[str, ...]
    planted: tuple[Planted, ...]
    outputs: frozenset[str]
    """Arguments that the command may write to."""

    @property
    def argv(self) -> list[str]:
        return ["aquaflow", *self.command.words, *self.arguments]


@dataclass(frozen=True)
class _Value:
    text: str
    planted: tuple[Planted, ...] = ()


DAMAGES = st.builds(
    Damage,
    kind=st.sampled_from(KINDS),
    file=st.floats(0.0, 1.0),
    at=st.floats(0.0, 1.0),
    size=st.integers(1, 64),
    token=st.sampled_from(HOSTILE_NUMBERS),
)


DAMAGES_OF_A_FILE = (0, 0, 0, 1, 1, 2)
"""As many are whole as are damaged: most damage ends a run before much of it was seen."""


@st.composite
def invocations(draw: st.DrawFn, command: Command, exemplars: tuple[str, ...]) -> Invocation:
    """Any call of ``command``: mostly whole, with a few options, on files mostly damaged."""
    parameters = [p for p in command.parameters if _is_usual(p) and draw(st.integers(0, 30))]
    optional = [p for p in command.parameters if not _is_usual(p)]
    if optional:
        parameters += draw(st.lists(st.sampled_from(optional), max_size=4, unique=True))
    arguments: list[str] = []
    planted: dict[str, Planted] = {}
    outputs: set[str] = set()
    for parameter in parameters:
        if parameter.kind is bool:
            arguments.append(draw(st.sampled_from(parameter.flags)))
            continue
        value = draw(_value(parameter, exemplars))
        planted |= {each.name: each for each in value.planted if each.name not in planted}
        arguments += _with_flag(parameter, value.text)
        if parameter.is_output:
            outputs.add(value.text)
    given = {argument.split("=")[0] for argument in arguments}
    quick = QUICK.get(command.name, {})
    arguments += [
        f"{flag}={text}" if text else flag for flag, text in quick.items() if flag not in given
    ]
    return Invocation(command, tuple(arguments), tuple(planted.values()), frozenset(outputs))


def _is_usual(parameter: Parameter) -> bool:
    """Without it, a command has nothing to do."""
    return parameter.required or parameter.name in USUAL


def _with_flag(parameter: Parameter, text: str) -> list[str]:
    """``--out=x``, so that a value may begin with a dash; an argument stands alone."""
    return [f"{parameter.flags[0]}={text}"] if parameter.flags else [text]


def _value(parameter: Parameter, exemplars: tuple[str, ...]) -> st.SearchStrategy[_Value]:
    if issubclass(parameter.kind, Enum):
        choices = [str(member.value) for member in parameter.kind]
        return st.sampled_from([*choices, *choices, *choices, "", "none"]).map(_Value)
    if parameter.name in ONLY:
        return st.sampled_from(ONLY[parameter.name]).map(_Value)
    if parameter.kind is Path:
        return _path(parameter, exemplars)
    if parameter.kind in (int, float):
        return numbers(parameter.kind).map(_Value)
    return st.sampled_from(TEXTS).map(_Value) | st.text(
        st.characters(exclude_characters="\0"), max_size=20
    ).map(_Value)


@st.composite
def _path(draw: st.DrawFn, parameter: Parameter, exemplars: tuple[str, ...]) -> _Value:
    """Mostly a file of the kind that is asked for; else any other, or no sane path at all."""
    chance = draw(st.integers(0, 9))
    if chance == 0:
        return _Value(draw(st.sampled_from(ABSURD_PATHS)))
    if parameter.is_output and chance < 8:
        return _Value(draw(st.sampled_from(("new", "new/deep", "new é"))))
    fitting = FITTING.get(parameter.name, exemplars)
    exemplar = draw(st.sampled_from(fitting if chance > 2 else exemplars))
    count = 0 if parameter.is_output else draw(st.sampled_from(DAMAGES_OF_A_FILE))
    damages = tuple(draw(st.lists(DAMAGES, min_size=count, max_size=count)))
    return _Value(exemplar, (Planted(exemplar, damages),))
