"""Health of the service: one state with its reason, and the list of its changes."""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from aquaflow.live.health.degradation import DegradationLevel
from aquaflow.live.health.pressure import Shortage
from aquaflow.sources.outbound import LONGEST_TEXT
from aquaflow.tracking.consistency import Cause

log = logging.getLogger(__name__)

KEPT = 50
"""Changes of state that are remembered."""


class ServiceState(str, Enum):
    """What the service does at the moment."""

    STARTING = "starting"
    WAITING = "waiting for camera"
    INITIALISING = "initialising"
    TRACKING = "tracking"
    LOST = "lost"
    DEGRADED = "degraded"
    STOPPING = "stopping"
    INCONSISTENT = "tracking, inconsistent"
    IDLE = "idle"
    PAUSED = "paused"
    FINISHING = "finishing a dive"

    @property
    def number(self) -> int:
        """The state as a number, for NAMED_VALUE_FLOAT and Prometheus."""
        return list(ServiceState).index(self)


@dataclass(frozen=True)
class Change:
    """A change from one state to another, and why."""

    t_s: float
    """CLOCK_MONOTONIC."""
    before: ServiceState
    after: ServiceState
    reason: str


class Health:
    """The state machine; to be written by the loop alone, read by anyone."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self.state = ServiceState.STARTING
        self.reason = "the service starts"
        self.sentences: tuple[str, ...] = ()
        """What the pilot shall hear of the reason; none: the state alone."""
        self.changes: deque[Change] = deque(maxlen=KEPT)
        self.visits: Counter[ServiceState] = Counter({ServiceState.STARTING: 1})
        self._now_s = now_s
        self.since_s = now_s()

    def set(self, state: ServiceState, reason: str, sentences: tuple[str, ...] = ()) -> bool:
        """Set the state; True if it changed. A new reason alone is no change."""
        if self.state is ServiceState.STOPPING:  # nothing comes after the end
            return False
        before, self.reason, self.sentences = self.state, reason, sentences
        if state is before:
            return False
        self.since_s = self._now_s()
        self.changes.append(Change(self.since_s, before, state, reason))
        self.visits[state] += 1
        self.state = state
        fields = {"event": "state", "before": before.value, "after": state.value}
        log.info("%s -> %s: %s", before.value, state.value, reason, extra={"fields": fields})
        return True

    def begin(self) -> None:
        """A dive begins: visits are counted anew."""
        self.visits.clear()
        self.visits[self.state] = 1


class ServiceWarning(NamedTuple):
    """Why something does not work."""

    reason: str
    """A clause, with what is known."""
    sentence: str
    """For the pilot: see :mod:`aquaflow.live.health.state`."""


class Judgement(NamedTuple):
    """The arguments of :meth:`Health.set`."""

    state: ServiceState
    reason: str
    sentences: tuple[str, ...] = ()


@dataclass(frozen=True)
class Facts:
    """The facts that determine the state."""

    frame_age_s: float
    """Since the last frame, or since the start."""
    patience_s: float
    """Longest time without a frame before the state is WAITING."""
    pictured: bool
    """A frame came since the start."""
    camera: ServiceWarning
    """Why the camera sends nothing, as its driver says."""
    posed: bool
    """The newest frame has a pose."""
    ever_posed: bool
    inconsistent: ServiceWarning | None
    """Why the poses of the last seconds are doubtful, by the monitor of scale."""
    troubles: list[ServiceWarning]
    """Why the service works with less than everything."""


def judge(facts: Facts) -> Judgement:
    """The state that follows from the facts, and its reason."""
    if facts.frame_age_s > facts.patience_s:
        said = f": {facts.camera.reason}" if facts.camera.reason else ""
        reason = f"no picture for {facts.frame_age_s:.0f} s{said}"
        return Judgement(ServiceState.WAITING, reason, (facts.camera.sentence,))
    if not facts.pictured:
        return Judgement(ServiceState.STARTING, "no picture yet")
    if not facts.ever_posed:
        reason = "no pose yet: the camera must move sideways over texture"
        return Judgement(ServiceState.INITIALISING, reason)
    if not facts.posed:
        reason = "the newest frames have no pose; the place is being looked for"
        return Judgement(ServiceState.LOST, reason)
    troubles = [each for each in (facts.inconsistent, *facts.troubles) if each is not None]
    if not troubles:
        return Judgement(ServiceState.TRACKING, "every frame has a pose")
    state = ServiceState.DEGRADED if facts.inconsistent is None else ServiceState.INCONSISTENT
    reason = "; ".join(each.reason for each in troubles)
    return Judgement(state, reason, tuple(each.sentence for each in troubles))


# --------------------------------------------------------------------------------------------------
# What the pilot hears: whole sentences that fit into one STATUSTEXT, whatever a device is called.
#
# A name that does not fit is left out, never cut. Ground stations speak these texts, so they hold
# no numbers, paths or errors; those are in the reason on the service's page.

OF_STATE = {
    ServiceState.STARTING: "AquaFlow starts.",
    ServiceState.WAITING: "AquaFlow: no picture from the camera.",
    ServiceState.INITIALISING: "AquaFlow: move sideways over texture to start.",
    ServiceState.TRACKING: "AquaFlow is tracking.",
    ServiceState.LOST: "AquaFlow is lost: go back to a mapped place.",
    ServiceState.DEGRADED: "AquaFlow works with less than everything.",
    ServiceState.INCONSISTENT: "AquaFlow: the map contradicts itself.",
    ServiceState.STOPPING: "AquaFlow stops.",
    ServiceState.IDLE: "AquaFlow waits for a dive to begin.",
    ServiceState.PAUSED: "AquaFlow is paused.",
    ServiceState.FINISHING: "AquaFlow finishes the dive.",
}
"""Of a state by itself."""
OF_CAUSE = {
    Cause.DEPTHS: "AquaFlow: the scale of the map has changed.",
    Cause.POSE: "AquaFlow: the scale of the map is doubtful.",
    Cause.MATCHES: "AquaFlow: few matches fit the map.",
}
"""Why tracking is inconsistent."""
OF_SHORTAGE = {
    Shortage.MEMORY: "low memory",
    Shortage.GPU_MEMORY: "low GPU memory",
    Shortage.HEAT: "too hot",
}
"""Why the service does less."""
OF_LEVEL = {
    DegradationLevel.FEWER_STEPS: "the map grows slower",
    DegradationLevel.SMALLER_IMAGES: "the map is coarser",
    DegradationLevel.TRACKING_ONLY: "the map rests",
    DegradationLevel.RECORDING_ONLY: "it only records",
}
"""What the service still does."""
TOO_SLOW = "AquaFlow: the computer is too slow."
DISK_FULL = "AquaFlow: the disk is full, nothing is kept."
MAPPING_FAILS = "AquaFlow: the map cannot grow, tracking goes on."
STAGE_FAILS = "AquaFlow: a stage fails again and again."
NOT_RECORDING = "AquaFlow does not record any more."


def no_picture(camera: str) -> str:
    """Reason of a camera that sends nothing."""
    return _fitting(f"AquaFlow: no picture from camera {camera}.", OF_STATE[ServiceState.WAITING])


def silent_link(name: str, heard_before: bool) -> str:
    """Reason of a link that was lost, or that was never heard."""
    if heard_before:
        return _fitting(f"AquaFlow: link {name} is lost.", "AquaFlow: a link is lost.")
    return _fitting(f"AquaFlow: nothing heard of {name}.", "AquaFlow: a link is silent.")


def doing_less(level: DegradationLevel, shortage: Shortage) -> str:
    """Reason of a service that sheds load."""
    return f"AquaFlow: {OF_SHORTAGE[shortage]}, {OF_LEVEL[level]}."


def _fitting(named: str, unnamed: str) -> str:
    return named if len(named) <= LONGEST_TEXT else unnamed
