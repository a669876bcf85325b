"""The one function that every call of ours passes: it counts, and it strikes once."""

from __future__ import annotations

import operator
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from . import callees
from .faults import Kind, strike, without_numbers

OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "Add": operator.add, "Sub": operator.sub, "Mult": operator.mul, "Div": operator.truediv,
    "FloorDiv": operator.floordiv, "Mod": operator.mod, "Pow": operator.pow,
    "MatMult": operator.matmul, "LShift": operator.lshift, "RShift": operator.rshift,
    "BitAnd": operator.and_, "BitOr": operator.or_, "BitXor": operator.xor,
}  # fmt: skip

Place = tuple[str, str]
"""File and function of ours."""


@dataclass(frozen=True, order=True)
class Site:
    """A library's function as one function of ours calls it."""

    library: str
    callee: str
    file: str
    function: str

    def __str__(self) -> str:
        return f"{self.callee} in {self.file}:{self.function}"


@dataclass
class Found:
    """What one dive did at a site."""

    calls: int = 0
    numbers: bool = False
    """It returned floating-point numbers."""


@dataclass(frozen=True)
class Strike:
    """One fault: at which call of a site, counted from one, and which."""

    site: Site
    call: int
    kind: Kind


@dataclass
class Moment:
    """Where in the dive something happened."""

    phase: str = "start"
    frame: int | None = None


@dataclass
class Watch:
    """Either counts the calls of a dive, or waits for the one that shall fail."""

    planned: Strike | None = None
    active: bool = False
    found: dict[Site, Found] = field(default_factory=dict)
    now: Moment = field(default_factory=Moment)
    struck: Moment | None = None
    on_strike: Callable[[Moment], None] = lambda moment: None
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _calls: Counter[Place] = field(default_factory=Counter)

    def called(self, place: Place, function: Any, /, *args: Any, **keywords: Any) -> Any:
        """Makes a call of ours."""
        if not self.active or (self.planned is not None and place != self._where):
            return function(*args, **keywords)
        return self._watched(place, function, args, keywords, function)

    def operated(self, place: Place, name: str, left: Any, right: Any, /) -> Any:
        """Applies a binary operator of ours; one of torch's tensors is a call into torch."""
        act = OPERATORS[name]
        if not self.active or (self.planned is not None and place != self._where):
            return act(left, right)
        tensors = "Tensor" in (type(left).__name__, type(right).__name__)
        callee = _TENSOR_OPERATORS[name] if tensors else act
        return self._watched(place, act, (left, right), {}, callee)

    @property
    def _where(self) -> Place:
        assert self.planned is not None
        return self.planned.site.file, self.planned.site.function

    def _watched(self, place: Place, function: Any, args: Any, keywords: Any, callee: Any) -> Any:
        named = (
            ("torch", callee.name)
            if isinstance(callee, _TensorOperator)
            else callees.library_of(callee)
        )
        if named is None:
            return function(*args, **keywords)
        site = Site(*named, *place)
        if self.planned is None:
            return self._counted(site, function(*args, **keywords))
        if site != self.planned.site or not self._is_it():
            return function(*args, **keywords)
        self.active = False
        self.struck = Moment(self.now.phase, self.now.frame)
        self.on_strike(self.struck)
        strike(self.planned.kind, site.library)
        result = function(*args, **keywords)
        return without_numbers(result) if self.planned.kind is Kind.NAN else result

    def _counted(self, site: Site, result: Any) -> Any:
        with self._lock:
            found = self.found.setdefault(site, Found())
            found.calls += 1
        found.numbers = found.numbers or without_numbers(result) is not result
        return result

    def _is_it(self) -> bool:
        assert self.planned is not None
        with self._lock:
            self._calls[self._where] += 1
            return self._calls[self._where] == self.planned.call


@dataclass(frozen=True)
class _TensorOperator:
    name: str


_TENSOR_OPERATORS = {name: _TensorOperator(f"torch.Tensor.{name}") for name in OPERATORS}
