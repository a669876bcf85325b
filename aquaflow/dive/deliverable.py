"""What is made of a dive beside the files of the core: reports, plan views, numbers of the ground.

Each is found by an entry point of ``GROUP``; so a site can have its own (docs/extending.md).
"""

from __future__ import annotations

from enum import IntEnum
from importlib.metadata import entry_points

from aquaflow.base.clocks.wall import Deadline
from aquaflow.dive.dive import Dive
from aquaflow.slam import Slam

GROUP = "aquaflow.deliverables"
"""Entry points: subclasses of :class:`Deliverable`, each called with the dive's ``Slam``."""


class DeliverablePhase(IntEnum):
    """When, at the end of a dive, a deliverable is made."""

    WRITE = 1
    """After trajectory, cameras, maps and places."""
    MEASURE = 2
    """After the held-out views were evaluated; within the time that the dive's end has."""
    REPORT = 3
    """Last, when everything but ``metrics.json`` is in the folder."""


class Deliverable:
    """One thing that is made of a dive. Whatever it raises costs itself alone."""

    phase = DeliverablePhase.WRITE
    stage: str
    """What is done, in words, for the note on a failure: ``drawing the overview``."""

    def __init__(self, slam: Slam) -> None:
        """``slam``: of the dive, before its first frame."""
        self.slam = slam

    def look(self) -> None:
        """Take in what is new of the dive; called while the frames of a replay come, after each
        keyframe. A live dive's coverage is looked at by a thread of its own."""

    def refresh(self, dive: Dive) -> None:
        """Make it of a ``dive`` that goes on, where that is cheap."""

    def make(self, dive: Dive, until: Deadline) -> None:
        """Make it of a ``dive`` that has ended, and write it into its folder.

        Args:
            dive: with everything that is in memory by now.
            until: when to leave out what can be left out.

        Raises:
            InputError: a file cannot be written.
        """
        raise NotImplementedError


def deliverables_of(slam: Slam) -> dict[str, Deliverable]:
    """One of each that is installed, by name, in the order in which they are made: by phase, then
    by name. One that cannot be loaded costs itself."""
    found: dict[str, Deliverable] = {}
    for entry in entry_points(group=GROUP):
        with slam.failures.contain(f"loading the deliverable {entry.name}"):
            found[entry.name] = entry.load()(slam)
    return dict(sorted(found.items(), key=lambda each: (each[1].phase, each[0])))
