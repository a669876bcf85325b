"""Views of a dive: what they may read while it goes on, and what is asked of them.

Each is an entry point of :data:`VIEWS`: whoever runs a dive knows no view, and no view knows them.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from aquaflow.base.errors import InputError
from aquaflow.base.errors.failures import Failures
from aquaflow.config.service import ViewerConfig

if TYPE_CHECKING:
    from aquaflow.dive.run import DiveRun
    from aquaflow.mapping.work import OwnedMaps
    from aquaflow.tracking.frames import Tracked
    from aquaflow.types import Frame

log = logging.getLogger(__name__)

VIEWS = "aquaflow.views"
"""Group of entry points; ``open_coverage``, ``open_viewer`` and ``open_finished`` say which there
are, and how each is called."""
LOOK_S = 0.1
"""Longest that ``show`` may wait for something new; then it is looked whether the thread shall
end."""
ENDING_S = 5.0
"""Longest wait for the thread's end; what it shows to may hang."""


class InspectedMaps(Protocol):
    """Maps that belong to another thread."""

    def inspect(self, name: str, job: Callable[[OwnedMaps, object], None]) -> None:
        """Let that thread call ``job`` soon with its maps; not waited for."""
        ...


class RunningDive(Protocol):
    """A dive that goes on."""

    dive_run: DiveRun
    picture: Frame | None
    """The newest frame."""
    latest: Tracked | None
    """The newest frame that has a pose."""

    @property
    def maps(self) -> InspectedMaps:
        """The maps of all its sub-maps."""
        ...


class DiveView(Protocol):
    """Shows one dive after another."""

    def show(self, dive: RunningDive) -> None:
        """From here on, this dive."""
        ...

    def update(self, dive: RunningDive) -> None:
        """After each frame, in tracking's thread: take what is new, never wait."""
        ...

    def close(self) -> None:
        """End its threads and close what listens."""
        ...


class CoverageView(DiveView, Protocol):
    """What the camera has seen, and what the pilot could do better; asked from any thread."""

    def hide(self) -> None:
        """From here on, no dive."""
        ...

    def sentences(self) -> tuple[str, ...]:
        """For the pilot, each fit for one STATUSTEXT: the hints that hold now."""
        ...

    def in_words(self) -> list[str]:
        """The hints that hold, with their values."""
        ...

    def to_json(self) -> dict[int, dict[str, Any]]:
        """What the page shows of the coverage, by sub-map."""
        ...

    def png(self) -> bytes | None:
        """The picture of the newest sub-map; None before there is one."""
        ...

    def cells(self, sub_map: int) -> bytes | None:
        """A sub-map as a picture with a pixel for each cell; None where there is none."""
        ...

    def plan(self, sub_map: int) -> Any:
        """A sub-map's cells, as the viewer colours its Gaussians by them; None where there are
        none."""
        ...


class ViewPage(Protocol):
    """A page that listens."""

    address: str

    def close(self) -> None:
        """Stop listening."""
        ...


class LiveView(DiveView, ViewPage, Protocol):
    """A view on a page of its own."""


def open_coverage(failures: Failures) -> CoverageView:
    """The entry point ``coverage``; its thread's errors go to ``failures``.

    Raises:
        InputError: it is not installed.
    """
    view: CoverageView = _load("coverage")(failures)
    return view


def open_viewer(
    config: ViewerConfig, report: Callable[[], dict[str, Any]], coverage: CoverageView | None
) -> LiveView:
    """The entry point ``viewer``, listening: map, path and, with ``coverage``, its classes.

    Args:
        report: of a service, as /health has it; of a replay, the keys that it has of them.

    Raises:
        InputError: it is not installed, or the address is taken.
        ConfigError: the token will not do.
    """
    view: LiveView = _load("viewer")(config, report, coverage and coverage.plan)
    return view


def open_finished(folder: Path, config: ViewerConfig) -> ViewPage:
    """The entry point ``finished``, listening: the dive folder that ``aquaflow view`` shows.

    Raises:
        InputError: it is not installed, the dive lacks a file, or the address is taken.
        ConfigError: the token will not do.
    """
    page: ViewPage = _load("finished")(folder, config)
    return page


def _load(name: str) -> Callable[..., Any]:
    for entry in entry_points(group=VIEWS, name=name):
        loaded: Callable[..., Any] = entry.load()
        return loaded
    raise InputError(f"no view '{name}' is installed; reinstall aquaflow")


class DisplayThread:
    """Calls ``show`` again and again in a thread of its own; what fails there costs the dive
    nothing."""

    def __init__(self, name: str, show: Callable[[], None], pause_s: float) -> None:
        """``pause_s``: after a failure, which is logged."""
        self._name, self._show, self._pause_s = name, show, pause_s
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        self._thread.join(ENDING_S)

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._show()
            except Exception:  # whatever somebody did who looks on, the dive goes on
                log.exception("the dive could not be shown: %s", self._name)
                self._closing.wait(self._pause_s)
