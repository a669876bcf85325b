"""Many runs: commands get their turns by time, finds are collected, a table is kept."""

from __future__ import annotations

import shutil
import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import hypothesis
from hypothesis import HealthCheck, Phase

from .child import Ended, Limits, run_forked, temporary_of
from .commands import Command
from .damage import apply_damage
from .invocations import Invocation, invocations
from .oracles import Find, contents, finds
from .privileges import own_to_nobody
from .values import INTERRUPTED

BATCH = 4
"""Runs of a command's turn, unless the session is told otherwise."""

LINKS = {"null": "/dev/null", "full": "/dev/full", "zero": "/dev/zero", "loop": "loop"}


@dataclass
class Tally:
    """What became of the runs of one command."""

    runs: int = 0
    codes: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    total_s: float = 0.0
    memory_mb: float = 0.0
    batches: int = 0

    def add(self, ended: Ended) -> None:
        self.runs += 1
        name = "hang" if ended.hung else f"{ended.code}{'i' if ended.interrupted else ''}"
        self.codes[name] += 1
        self.slowest_s = max(self.slowest_s, ended.wall_s)
        self.total_s += ended.wall_s
        self.memory_mb = max(self.memory_mb, ended.memory_mb)


@dataclass(frozen=True)
class Found:
    """The first run that showed a find."""

    invocation: Invocation
    find: Find


class Session:
    """A fuzzing session over ``commands`` with the examples in ``exemplars``."""

    def __init__(
        self,
        commands: list[Command],
        exemplars: Path,
        work: Path,
        seed: int,
        interrupt_s: float = 12.0,
        keep: Path | None = None,
        batch: int = BATCH,
    ) -> None:
        from aquaflow.cli import main

        self.main: Callable[[], None] = main
        self.commands, self.exemplars, self.work = commands, exemplars, work
        self.seed, self.interrupt_s, self.keep = seed, interrupt_s, keep
        self.batch = batch
        self.names = tuple(sorted(path.name for path in exemplars.iterdir()))
        self.tallies = {command.name: Tally() for command in commands}
        self.found: dict[str, Found] = {}
        self.repeats: Counter[str] = Counter()

    def run(self, seconds: float) -> None:
        """Give turns until ``seconds`` have passed; every command gets one at least."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s or any(not t.runs for t in self.tallies.values()):
            self._turn(min(self.commands, key=self._due))

    def _due(self, command: Command) -> float:
        tally = self.tallies[command.name]
        return -1.0 if tally.batches == 0 else tally.total_s / command.weight

    def _turn(self, command: Command) -> None:
        """One batch; its draws follow from the seed, the command and the number of the turn."""
        tally = self.tallies[command.name]
        tally.batches += 1
        key = zlib.crc32(f"{self.seed} {command.name} {tally.batches}".encode())

        @hypothesis.seed(key)
        @hypothesis.settings(
            max_examples=self.batch, phases=[Phase.generate], database=None, deadline=None,
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        @hypothesis.given(invocations(command, self.names))
        def each(invocation: Invocation) -> None:
            self.try_out(invocation)

        each()

    def try_out(self, invocation: Invocation) -> list[Find]:
        """Run once, judge, and take note."""
        folder = self.work / "here"
        temporary = temporary_of(folder)
        for path in (folder, temporary):
            shutil.rmtree(path, ignore_errors=True)
            path.mkdir()
        self._plant(invocation, folder)
        own_to_nobody(folder, temporary)
        before = contents(folder)
        name = invocation.command.name
        limits = Limits(self.interrupt_s if name in INTERRUPTED else None)
        ended = run_forked(self.main, invocation.argv, folder, limits)
        self.tallies[name].add(ended)
        found = finds(name, invocation.argv, invocation.outputs, folder, before, ended)
        for find in found:
            self._note(invocation, find, folder)
        return found

    def _plant(self, invocation: Invocation, folder: Path) -> None:
        for name, target in LINKS.items():
            (folder / name).symlink_to(target)
        for planted in invocation.planted:
            there = folder / planted.name
            whole = self.exemplars / planted.exemplar
            (shutil.copytree if whole.is_dir() else shutil.copy)(whole, there)
            for damage in planted.damages:
                if there.is_dir() or there.is_file():
                    apply_damage(there, damage)

    def _note(self, invocation: Invocation, find: Find, folder: Path) -> None:
        signature = f"{invocation.command.name}: {find.signature}"
        self.repeats[signature] += 1
        if signature in self.found:
            return
        self.found[signature] = Found(invocation, find)
        print(
            f"\n### {signature}\n{invocation.argv}\n{invocation.planted}\n{find.detail[-2500:]}",
            flush=True,
        )
        if self.keep is not None:
            kept = self.keep / f"{len(self.found):03d}"
            shutil.copytree(folder, kept, symlinks=True, dirs_exist_ok=True)
            (kept / ".find").write_text(f"{invocation}\n{find.detail}", errors="backslashreplace")
