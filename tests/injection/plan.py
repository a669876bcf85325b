"""Which faults are brought into which dives: every site once for each kind, or a sample of them."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from . import callees
from .dives import Dive
from .faults import Kind
from .watch import Found, Site, Strike


@dataclass(frozen=True)
class Task:
    """One dive with one fault."""

    dive: Dive
    strike: Strike


Reached = Mapping[tuple[str, Site], tuple[Dive, Found]]
"""By command and site: the first dive that reached it, and what it did there."""


def tasks_for(reached: Reached, kinds: Sequence[Kind], seed: int) -> list[Task]:
    """Every site with every kind that it can have, each at a call drawn by ``seed``."""
    tasks = []
    for (command, site), (dive, found) in sorted(reached.items(), key=lambda item: item[0]):
        for kind in kinds:
            if can_have(kind, site, found):
                drawn = random.Random(f"{seed} {command} {site} {kind.value}")
                tasks.append(Task(dive, Strike(site, drawn.randint(1, found.calls), kind)))
    return tasks


def can_have(kind: Kind, site: Site, found: Found) -> bool:
    """NaN needs numbers, a full disk something that is written."""
    if kind is Kind.NAN:
        return found.numbers
    if kind is Kind.FULL:
        return site.library == callees.FILE and callees.is_write(site.callee)
    return True


def sampled(tasks: Sequence[Task], count: int, seed: int) -> list[Task]:
    """``count`` tasks, spread over commands, libraries and kinds."""
    drawn = random.Random(seed)
    groups: dict[tuple[str, str, Kind], list[Task]] = {}
    for task in tasks:
        key = (task.dive.command, task.strike.site.library, task.strike.kind)
        groups.setdefault(key, []).append(task)
    for group in groups.values():
        drawn.shuffle(group)
    chosen: list[Task] = []
    while len(chosen) < count and any(groups.values()):
        keys = [key for key, group in groups.items() if group]
        drawn.shuffle(keys)
        chosen += [groups[key].pop() for key in keys[: count - len(chosen)]]
    return chosen
