"""What the pilot asked for: between those who ask, in any thread, and the service, which obeys.

One process serves several dives, one after the other. Requests come from HTTP, MAVLink and signals;
the service looks here at every turn.
"""

from __future__ import annotations

import threading
from enum import Enum

from aquaflow.base.errors import AquaFlowError


class DivePhase(str, Enum):
    """Where the service is in a dive; a request changes it at once, the service follows."""

    IDLE = "idle"
    MAPPING = "mapping"
    PAUSED = "paused"
    FINISHING = "finishing"


class ServiceRequest(str, Enum):
    """What a pilot may ask for."""

    START = "start"
    """Begin a dive, or go on with the paused one."""
    STOP = "stop"
    """Pause: pictures are not mapped any more, the dive stays open."""
    FINISH = "finish"
    """Refine, write the deliverables, and be idle."""
    NEW = "new"
    """Finish the present dive, if there is one, and begin another."""


AFTER: dict[tuple[ServiceRequest, DivePhase], DivePhase] = {
    (ServiceRequest.START, DivePhase.IDLE): DivePhase.MAPPING,
    (ServiceRequest.START, DivePhase.PAUSED): DivePhase.MAPPING,
    (ServiceRequest.STOP, DivePhase.MAPPING): DivePhase.PAUSED,
    (ServiceRequest.FINISH, DivePhase.MAPPING): DivePhase.FINISHING,
    (ServiceRequest.FINISH, DivePhase.PAUSED): DivePhase.FINISHING,
    (ServiceRequest.NEW, DivePhase.IDLE): DivePhase.MAPPING,
    (ServiceRequest.NEW, DivePhase.MAPPING): DivePhase.FINISHING,
    (ServiceRequest.NEW, DivePhase.PAUSED): DivePhase.FINISHING,
}
"""Requests that make sense, and what they lead to."""

REFUSALS = {
    DivePhase.IDLE: "there is no dive; start one first",
    DivePhase.MAPPING: "the dive is being mapped already",
    DivePhase.PAUSED: "the dive is paused already",
    DivePhase.FINISHING: "the dive is being finished; ask again when that is done",
}
"""Why the others do not, in each phase."""


class RefusedError(AquaFlowError):
    """A request that makes no sense now."""


class ServiceControl:
    """The present phase, and whether the service shall end."""

    def __init__(self) -> None:
        self.stopping = threading.Event()
        """Set: the service ends, and leaves a dive that can be gone on with. For any thread, and
        for signal handlers."""
        self.told = threading.Event()
        """Set: by a signal, whose sender kills the process after a while."""
        self._lock, self._asked = threading.Lock(), threading.Event()
        self._phase = DivePhase.IDLE
        self._another = False
        """A new dive is wanted, whatever could be gone on with."""

    @property
    def phase(self) -> DivePhase:
        """What is wanted now."""
        return self._phase

    @property
    def paused(self) -> bool:
        """True while pictures shall not be mapped."""
        return self._phase is DivePhase.PAUSED

    @property
    def dive_ends(self) -> bool:
        """True once the dive in progress shall come to its end."""
        return self.stopping.is_set() or self._phase is DivePhase.FINISHING

    def ask(self, request: ServiceRequest) -> DivePhase:
        """Ask for something; the phase that follows from it.

        Raises:
            RefusedError: it makes no sense now.
        """
        with self._lock:
            if self.stopping.is_set():
                raise RefusedError("the service is ending")
            after = AFTER.get((request, self._phase))
            if after is None:
                raise RefusedError(REFUSALS[self._phase])
            self._another |= request is ServiceRequest.NEW
            self._phase = after
            self._asked.set()
            return after

    # --- the service's side ---------------------------------------------------------------------

    def wait(self, seconds: float) -> None:
        """Wait until somebody asks for something, at most so long."""
        self._asked.wait(max(seconds, 0.0))
        self._asked.clear()

    def wake(self) -> None:
        """End a :meth:`wait`."""
        self._asked.set()

    def begin(self) -> bool:
        """The wanted dive is being begun; True if it shall be a new one."""
        with self._lock:
            another, self._another = self._another, False
            return another

    def end_dive(self) -> None:
        """The dive was closed, or could not be begun: the service is idle, or begins the next."""
        with self._lock:
            self._phase = DivePhase.MAPPING if self._another else DivePhase.IDLE
