"""What a browser may ask for by pointing at the map; all of it is checked, and answers in words."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.survey.measure.points import MOST_POINTS
from aquaflow.survey.viewer.measuring import Asked, LengthUnit, MeasuringScene, measure, ray_of
from aquaflow.survey.viewer.picking import pick
from aquaflow.survey.viewer.viewer_content import ShownMap, ViewerContent
from aquaflow.telemetry.world_frame import WorldFrame

NOTES, SCALE = ("notes/list", "notes/add", "notes/remove"), "scale"
"""Names of the tools that a finished dive has besides."""
BUSY_S = 20.0
"""A browser waits so long for the one before it; then it is told so."""


@dataclass
class Tools:
    """Answers browsers, one at a time; ``others`` are a dive's own tools by name."""

    frame: LengthUnit = field(default_factory=lambda: LengthUnit.of(WorldFrame.unknown()))
    others: dict[str, Callable[[Asked], Asked]] = field(default_factory=dict)
    exhibit: ViewerContent | None = None
    _turn: threading.Lock = field(default_factory=threading.Lock)

    def can(self) -> tuple[str, ...]:
        """Which buttons the page has besides those that measure."""
        found = {"note": set(NOTES) <= set(self.others), "scale": SCALE in self.others}
        return tuple(name for name, there in found.items() if there)

    def ask(self, name: str, given: Asked) -> Asked:
        """What the tool of that name says.

        Raises:
            InputError: there is no such tool, or it cannot do that, in a sentence for the browser.
        """
        tool = {"pick": self._pick, "measure": self._measure, **self.others}.get(name)
        if tool is None:
            raise InputError("this dive has no such tool; reload the page")
        if not self._turn.acquire(timeout=BUSY_S):
            raise InputError("the viewer is busy with other requests; try again")
        try:
            return tool(given)
        finally:
            self._turn.release()

    def _pick(self, given: Asked) -> Asked:
        found = pick(self._map().splats(), *ray_of(given))
        return {"place": found.place.tolist(), "range": found.range, "sigma": found.sigma}

    def _measure(self, given: Asked) -> Asked:
        asked = given.get("points")
        if not isinstance(asked, list) or not 0 < len(asked) <= MOST_POINTS:
            raise InputError(f"a measurement needs 1 to {MOST_POINTS} points; mark them again")
        if not all(isinstance(each, dict) for each in asked):
            raise InputError("a point to measure is none; mark it again")
        shown, exhibit = self._map(), self.exhibit
        assert exhibit is not None
        camera = exhibit.camera
        width = 1.0 if camera is None else camera.camera.width / camera.camera.fx
        cameras = exhibit.path[:, :3].astype(np.float64)
        scene = MeasuringScene(shown.splats(), cameras, width, np.array(exhibit.up), self.frame)
        return measure(str(given.get("what")), asked, scene)

    def _map(self) -> ShownMap:
        shown = None if self.exhibit is None else self.exhibit.map
        if shown is None:
            raise InputError("there is no map yet to point at; wait for it")
        return shown
