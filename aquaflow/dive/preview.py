"""A preview of a replay: the viewer of a running dive, shown what the mapping thread has.

All of it is taken between two steps of that thread, from what it keeps anyway: a dive's files are
the same bytes with and without it (tests/cli/test_map_view.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from aquaflow.base.errors import InputError
from aquaflow.base.progress import Course, Progress
from aquaflow.config.service import ViewerConfig
from aquaflow.dive.metric_outputs import metric_frame_numbers
from aquaflow.dive.views import LiveView, RunningDive, open_viewer
from aquaflow.mapping.work import OwnedMaps

if TYPE_CHECKING:
    from aquaflow.dive.run import DiveRun
    from aquaflow.tracking.frames import Tracked
    from aquaflow.types import Frame


class Preview(RunningDive):
    """Construct before a replay and pass it there; close it when nobody shall look any more."""

    def __init__(self) -> None:
        """Listen at the viewer's port, or, where that is taken, at any that is free.

        Raises:
            InputError: the viewer is not installed, or cannot listen.
        """
        self.picture: Frame | None = None
        self.latest: Tracked | None = None
        self._course = Course()
        self._progress: Progress = lambda stage, done, total: None
        self._facts: dict[str, Any] = {}
        self._finished: Path | None = None
        self._viewer = self._open()
        self.address = self._viewer.address

    def _open(self) -> LiveView:
        config = ViewerConfig(enabled=True)
        try:
            return open_viewer(config, self.report, None)
        except InputError:  # an earlier dive is still looked at, or another one mapped
            any_port = config.model_copy(update={"port": 0})
            return open_viewer(any_port, self.report, None)

    def report(self) -> dict[str, Any]:
        """How far the replay is; for the viewer's thread."""
        stage = self._course.stage
        said = (stage, self._course.steps()) if stage else ("reading", "the recording")
        if self._finished is not None:
            said = "finished", str(self._finished)
        return self._facts | {"state": said[0], "reason": said[1]}

    def begin(self, run: DiveRun, progress: Progress) -> Progress:
        """The replay begins; what it has to call from here on in place of ``progress``."""
        self.dive_run, self._progress = run, progress
        self._viewer.show(self)
        return self._advance

    @property
    def maps(self) -> Preview:
        """As the viewer asks for them: see :meth:`inspect`."""
        return self

    def inspect(self, name: str, job: Callable[[OwnedMaps, object], None]) -> None:
        """Call ``job`` at once: the thread that shows the replay owns its maps."""
        job(cast(OwnedMaps, self.dive_run.slam.maps), ())

    def take(self, frame: Frame, decided: Sequence[Tracked]) -> None:
        """A frame was read, and ``decided`` are those that it finished."""
        self.picture = frame
        for tracked in decided:
            if tracked.T_wc is not None and tracked.frame.index == frame.index:
                self.latest = tracked.bare()

    def _advance(self, stage: str, done: int, total: int | None) -> None:
        self._progress(stage, done, total)
        self._course.advance(stage, done, total)
        slam = self.dive_run.slam
        with slam.failures.contain("preview"):
            self._facts = {
                "keyframes": len(slam.keyframes),
                "gaussians": self._gaussians(),
                "metric_frame": metric_frame_numbers(slam.metric_frame(slam.tracker.sub_map)),
            }
            self._viewer.update(self)

    def _gaussians(self) -> int | None:
        slam = self.dive_run.slam
        if not slam.config.mapping.enabled:
            return None
        return sum(mapper.count for mapper in slam.mappers.values())

    def finish(self, dive: Path) -> None:
        """The dive is written; what was shown last stays."""
        self._finished = dive

    def close(self) -> None:
        """Stop listening."""
        self._viewer.close()

    def __enter__(self) -> Preview:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
