"""kill -9 at a random moment of each command here; ``make test-all`` takes twenty of each, and
``batch``, whose every case maps several dives."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.kills.campaign import COMMANDS, attack
from tests.kills.commands import Bench

SEED = 40


@pytest.fixture(scope="module")
def bench(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("kills"), small_recording)


@pytest.mark.ci
@pytest.mark.parametrize("command", [each for each in COMMANDS if each != "batch"])
def test_a_killed_command_leaves_nothing_that_passes_as_finished_and_can_be_given_again(
    bench: Bench, command: str
) -> None:
    tally = attack(bench, command, moments=1, seed=SEED)
    assert tally.wrong == []
    assert tally.found.total() > 0


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_twenty_kills_of_each_command(bench: Bench, command: str) -> None:
    tally = attack(bench, command, moments=20, seed=SEED + 1)
    assert tally.wrong == []
    assert tally.killed >= 10
