"""Runs stress cases, one after the other, each from its own seed."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import cv2
import torch

from aquaflow.base.errors import ArgumentError
from aquaflow.lab.stress.case import REGISTRY, Case, StressOutcome

FAMILIES = (
    "images", "motion", "time", "water", "gaussians", "solvers", "precision", "soak",
)  # fmt: skip
"""As the table groups the cases."""
_MODULES = (
    "images", "motion", "clock", "water", "gaussians", "optimisation", "solvers", "precision",
    "soak", "hovering",
)  # fmt: skip
"""Those that register cases, in the order of the table."""


@dataclass(frozen=True)
class Result:
    """One row of the table."""

    case: Case
    seed: int
    outcome: StressOutcome

    @property
    def command(self) -> str:
        """What reproduces this row."""
        long = " --long" if self.case.long else ""
        return f"aquaflow lab stress --case {self.case.name} --seed {self.seed}{long}"

    def to_json(self) -> dict[str, Any]:
        """The stable keys of docs/formats.md#json-output; ``worst`` may be null."""
        worst = self.outcome.worst
        return {
            "name": self.case.name,
            "family": self.case.family,
            "passed": self.outcome.passed,
            "worst": worst if math.isfinite(worst) else None,
            "guard": self.case.guard,
            "seed": self.seed,
            "detail": self.outcome.detail,
        }


def cases(family: str | None = None, name: str | None = None, long: bool = False) -> list[Case]:
    """The registered cases, in the order of the families.

    Raises:
        ArgumentError: there is no such family or case.
    """
    for module in _MODULES:
        import_module(f"aquaflow.lab.stress.{module}")
    if family is not None and family not in FAMILIES:
        raise ArgumentError(f"there is no family '{family}'; families are {', '.join(FAMILIES)}")
    if name is not None:
        if name not in REGISTRY:
            raise ArgumentError(
                f"there is no stress case '{name}'; `aquaflow lab stress` lists them"
            )
        return [REGISTRY[name]]
    chosen = [case for case in REGISTRY.values() if family in {None, case.family}]
    return [case for case in chosen if long or not case.long]


@contextmanager
def on_few_threads() -> Iterator[None]:
    """One thread for BLAS and torch: their threads wait for each other over matrices this small."""
    from threadpoolctl import threadpool_limits

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)


def run_case(case: Case, seed: int) -> Result:
    """Run one case; an exception that gets out of it is a failure, whatever its type."""
    cv2.setRNGSeed(seed)
    quiet = logging.NullHandler()
    logging.getLogger("aquaflow").addHandler(quiet)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            outcome = case.run(seed)
    except Exception as error:
        said = " ".join(str(error).split())[:160]
        outcome = StressOutcome(math.inf, False, f"raised {type(error).__name__}: {said}")
    finally:
        logging.getLogger("aquaflow").removeHandler(quiet)
    return Result(case, seed, outcome)


def run_cases(
    chosen: list[Case], seed: int, finished: Callable[[Result, int, int], None] | None = None
) -> list[Result]:
    """Run ``chosen`` in order; ``finished`` gets each result, its number and their count."""
    results = []
    for number, case in enumerate(chosen, 1):
        results.append(run_case(case, seed))
        if finished is not None:
            finished(results[-1], number, len(chosen))
    return results
