"""Deliverables behind entry points: found, ordered, and each a failure of its own."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors.failures import Failures
from aquaflow.config import Config
from aquaflow.dive import deliverables as module
from aquaflow.dive.deliverables import Deliverable, DeliverablePhase, deliverables_of
from aquaflow.dive.dive import Dive


class Late(Deliverable):
    phase, stage = DeliverablePhase.REPORT, "the last"


class Early(Deliverable):
    stage = "the first"

    def make(self, dive: Dive, until: Deadline) -> None:
        dive.file("early").write_text(dive.name)


def unloadable() -> type[Deliverable]:
    raise ImportError("its library is missing")


def entry(name: str, load: Callable[[], type[Deliverable]]) -> Any:
    return SimpleNamespace(name=name, load=load)


@pytest.fixture
def slam() -> Any:
    return SimpleNamespace(config=Config(), failures=Failures(strict=False))


def test_the_ones_of_survey_are_installed_in_the_order_of_their_files(slam: Any) -> None:
    assert list(deliverables_of(slam)) == ["coverage", "overview", "reef_numbers", "report"]


def test_they_are_made_by_phase_and_then_by_name(
    slam: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = [entry("a", lambda: Late), entry("c", lambda: Early), entry("b", lambda: Early)]
    monkeypatch.setattr(module, "entry_points", lambda *, group: entries)
    assert list(deliverables_of(slam)) == ["b", "c", "a"]


def test_one_that_cannot_be_loaded_costs_itself(slam: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [entry("broken", unloadable), entry("early", lambda: Early)]
    monkeypatch.setattr(module, "entry_points", lambda *, group: entries)
    assert list(deliverables_of(slam)) == ["early"]
    [kind] = slam.failures.kinds
    assert kind.stage == "loading the deliverable broken"
