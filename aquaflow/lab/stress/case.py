"""What a stress case is, how it judges, and the registry of them all."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from aquaflow.geometry.similarity import Sim3

ROTATION_ERROR = 1e-9
"""Largest deviation of R^T R from the identity that still counts as a rotation (float64)."""


@dataclass(frozen=True)
class StressOutcome:
    """What one case did."""

    worst: float
    """The measured value that came nearest to its bound, or went furthest past it."""
    passed: bool
    detail: str
    """What was measured, or the expectations that failed."""


@dataclass(frozen=True)
class Case:
    """One hard input and the behaviour expected of it."""

    name: str
    family: str
    guard: str
    """The function or constant that must catch it, as ``module.name``."""
    run: Callable[[int], StressOutcome]
    """From the seed of all random draws."""
    long: bool
    """True if it takes minutes and belongs to the long form only."""


REGISTRY: dict[str, Case] = {}
"""All cases by name; importing a module adds its own."""


def case(
    family: str, guard: str, long: bool = False
) -> Callable[[Callable[[Check, int], None]], Callable[[Check, int], None]]:
    """Register a function (check, seed) under its own name."""

    def register(body: Callable[[Check, int], None]) -> Callable[[Check, int], None]:
        def run(seed: int) -> StressOutcome:
            check = Check()
            body(check, seed)
            return check.outcome()

        assert body.__name__ not in REGISTRY, body.__name__
        REGISTRY[body.__name__] = Case(body.__name__, family, guard, run, long)
        return body

    return register


class Check:
    """Collects what a case measured against what it expects."""

    def __init__(self) -> None:
        self._failures: list[str] = []
        self._ratio, self._worst, self._measured = -1.0, 0.0, ""

    def true(self, what: str, holds: bool) -> None:
        """``what`` is expected to hold."""
        if not holds:
            self._failures.append(f"not so: {what}")

    def below(self, what: str, value: float, bound: float) -> None:
        """``value`` is expected to be a number no larger than ``bound`` > 0."""
        ratio = value / bound if math.isfinite(value) else math.inf
        if ratio > self._ratio:
            self._ratio, self._worst = ratio, value
            self._measured = f"{what} {value:.3g} of at most {bound:.3g}"
        if not ratio <= 1.0:
            self._failures.append(f"{what} is {value:.3g}, more than {bound:.3g}")

    def finite(
        self,
        what: str,
        *arrays: npt.ArrayLike | torch.Tensor | None,  # [...] any shape
    ) -> None:
        """Every entry is expected to be a number."""
        for array in arrays:
            if array is None:
                continue
            values = array.detach().numpy() if isinstance(array, torch.Tensor) else array
            bad = int((~np.isfinite(np.asarray(values, dtype=np.float64))).sum())
            if bad:
                self._failures.append(f"{what} has {bad} entries that are not finite")

    def pose(self, what: str, T: Sim3) -> None:
        """A pose is expected to be finite, a rotation, of unit quaternion and positive scale."""
        self.finite(what, T.R, T.t, T.scale)
        if not (T.is_finite() and np.linalg.det(T.R) > 0.0):
            self._failures.append(f"{what} is no similarity")
            return
        skew = float(np.abs(T.R.T @ T.R - np.eye(3)).max())
        self.below(f"{what}: orthogonality error", skew, ROTATION_ERROR)
        self.below(f"{what}: det R - 1", abs(float(np.linalg.det(T.R)) - 1.0), ROTATION_ERROR)
        length = float(np.linalg.norm(T.quaternion))
        self.below(f"{what}: quaternion length - 1", abs(length - 1.0), ROTATION_ERROR)

    def outcome(self) -> StressOutcome:
        """Passed, or the first failure and how many more there are."""
        if self._failures:
            more = len(self._failures) - 1
            detail = self._failures[0] + (f" (and {more} more)" if more else "")
            return StressOutcome(self._worst if self._ratio > 1.0 else math.inf, False, detail)
        return StressOutcome(self._worst, True, self._measured)
