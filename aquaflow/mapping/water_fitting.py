"""When the water is fitted, and that no frame waits for it: a few steps with each new view."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Generator, Mapping, Sequence

import numpy as np
import torch

from aquaflow.base.errors.failures import Failures
from aquaflow.config import MediumConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.scene import Scene
from aquaflow.mapping.scene_water import adopt_water, fitting_water
from aquaflow.render.views import View, in_time
from aquaflow.water.pauses import run_to_end

log = logging.getLogger(__name__)

OTHER_UNIT = 0.02
"""Relative change of scale from which on ranges seen before and after do not belong together.
Places that moved are left out one by one, where the map's range no longer agrees."""
STEPS = 2
"""Of a fit with each new view: at 480 px one of them, a picture of the map or a few steps of the
solver, takes 10 to 30 ms of two cores."""


class WaterFitting:
    """Fits a scene's water after a number of views, at every doubling of it, and on request."""

    def __init__(
        self,
        config: MediumConfig,
        scene: Scene,
        generator: torch.Generator,
        failures: Failures,
    ) -> None:
        self.config, self.scene, self.failures = config, scene, failures
        self._random = generator
        self.next_fit = config.first_fit_views
        """Number of views at which the next fit begins."""
        self._under_way: Generator[None, None, None] | None = None

    def go_on(self, views: Sequence[View]) -> bool:
        """A few steps, if there is a fit to be made; True if it has ended with them."""
        if self._under_way is None and len(views) >= self.next_fit:
            self._under_way = self._fitting(views)
        if self._under_way is None:
            return False
        ended = True
        with self.failures.contain("water fit"):
            ended = sum(1 for _ in itertools.islice(self._under_way, STEPS)) < STEPS
        if ended:
            self._end(views)
        return ended

    def at_once(self, views: Sequence[View]) -> None:
        """A whole fit, from its beginning."""
        with self.failures.contain("water fit"):
            run_to_end(self._fitting(views))
        self._end(views)

    def follow_moves(self, moves: Mapping[int, Sim3]) -> None:
        """Keyframes have moved: a fit under way begins again if the map's unit did."""
        if any(abs(move.scale - 1.0) > OTHER_UNIT for move in moves.values()):
            self.begin_again()

    def begin_again(self) -> None:
        """Drop a fit that is under way: what it has seen is no longer where it was. It begins again
        with the next view."""
        self._under_way = None

    def _end(self, views: Sequence[View]) -> None:
        self._under_way = None
        self.next_fit = max(self.next_fit, 2 * len(views))

    def _fitting(self, views: Sequence[View]) -> Generator[None, None, None]:
        """To views spread over the dive so far; pauses every few milliseconds."""
        ordered = in_time(views)
        count = min(self.config.fit_views, len(ordered))
        chosen = np.linspace(0, len(ordered) - 1, count).astype(int)
        fit = fitting_water(self.scene, [ordered[i] for i in chosen], self._random)
        estimate, fitted = yield from fit
        if estimate is None:
            return
        adopt_water(self.scene, estimate, fitted, in_time(views))
        log.info(
            "water fitted: %s, beta_a %s per map unit (relative sigma %s)",
            estimate.model,
            estimate.beta_a.round(3).tolist(),
            estimate.beta_a_sigma,
        )
