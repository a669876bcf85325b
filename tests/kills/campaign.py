"""Kills each command at moments that a seed draws, and judges what is left and what comes after."""

from __future__ import annotations

import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.command_line import run_aquaflow
from tests.kills.commands import Bench, WrongError

COMMANDS = ("map", "run", "site_merge", "export", "batch")
LOOK_S = 0.003
"""Between two looks at the folder that a command writes to."""
LONGEST_S = 0.05
"""From the change in the folder after which a command is killed to the kill, at most."""


@dataclass
class Tally:
    """What became of one command."""

    killed: int = 0
    ended_before: int = 0
    found: Counter[str] = field(default_factory=Counter)
    """After the kill, in a word."""
    wrong: list[str] = field(default_factory=list)

    def in_words(self) -> str:
        """One line."""
        found = ", ".join(f"{count} {what}" for what, count in sorted(self.found.items()))
        return f"{self.killed} killed, {self.ended_before} ended before: {found}"


def attack(
    bench: Bench,
    command: str,
    moments: int,
    seed: int,
    tell: Callable[[str], None] = lambda _: None,
) -> Tally:
    """Kill ``command`` ``moments`` times, each in a folder of its own; ``tell`` hears of each."""
    rng, tally = random.Random(f"{seed} {command}"), Tally()
    changes: dict[object, int] = {}
    for number in range(moments):
        case = getattr(bench, command)(number)
        kind = case.words[: 4 if command == "export" else 1]
        if kind not in changes:
            watch = Watch(case.out)
            run_aquaflow(*case.words, meanwhile=watch)
            changes[kind] = max(watch.changes, 1)
            case = getattr(bench, command)(number)
        watch = Watch(case.out, rng.randint(0, changes[kind]), rng.uniform(0.0, LONGEST_S))
        ran = run_aquaflow(*case.words, meanwhile=watch)
        died = ran.code == -signal.SIGKILL
        tally.killed, tally.ended_before = tally.killed + died, tally.ended_before + (not died)
        at = f"{command} {number}, after {watch.kill_after} of {changes[kind]} changes"
        try:
            found = case.check()
            tally.found[found] += 1
            case.again()
            tell(f"{at}: {'killed' if died else 'ended before'}, {found}")
        except WrongError as error:
            tally.wrong.append(f"{at}: {error}")
            tell(tally.wrong[-1])
    return tally


class Watch:
    """Counts what changes in a folder while a process runs, and kills it at its moment."""

    def __init__(self, folder: Path, kill_after: int | None = None, then_s: float = 0.0) -> None:
        """``kill_after`` so many changes, ``then_s`` later; None: never."""
        self.changes, self.kill_after, self.then_s = 0, kill_after, then_s
        self._folder, self._seen = folder, dict[str, int]()
        self._look()
        self.changes = 0

    def __call__(self, process_id: int) -> None:
        """Watch ``process_id`` until it was killed, or is gone."""
        while Path(f"/proc/{process_id}").exists():
            if self.kill_after is not None and self.changes >= self.kill_after:
                time.sleep(self.then_s)
                if Path(f"/proc/{process_id}").exists():
                    os.kill(process_id, signal.SIGKILL)
                return
            time.sleep(LOOK_S)
            self._look()

    def _look(self) -> None:
        now: dict[str, int] = {}
        for folder, _, names in os.walk(self._folder):
            for path in (f"{folder}/{name}" for name in names):
                try:
                    now[path] = os.stat(path).st_mtime_ns
                except OSError:  # it is gone again
                    continue
        gone = len(self._seen.keys() - now.keys())
        self.changes += gone + len(set(now.items()) - set(self._seen.items()))
        self._seen = now
