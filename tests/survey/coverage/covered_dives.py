"""A running dive above even ground, of which the test makes every keyframe and picture."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from aquaflow.base.errors.failures import Failures
from aquaflow.config.service import CoverageConfig
from aquaflow.keyframes import Pointmap
from aquaflow.survey.coverage.coverage_files import CoverageFiles
from aquaflow.survey.coverage.live_coverage import LiveCoverage
from tests.survey.coverage.surveys import ALTITUDE, CAMERA, above, metric


class CoveredDive:
    """What the live coverage reads of a dive; its thread takes no turns of its own."""

    def __init__(self, attenuation: float | None = None) -> None:
        self.keyframes: list[Any] = []
        self.attenuation = attenuation
        self.config = SimpleNamespace(coverage=CoverageConfig())
        store = SimpleNamespace(keyframes=self.keyframes)
        slam = SimpleNamespace(keyframes=store, metric_frame=lambda _: metric())
        slam_to_be: Any = SimpleNamespace(config=self.config)
        made, maps = {"coverage": CoverageFiles(slam_to_be)}, SimpleNamespace(inspect=self._inspect)
        run = SimpleNamespace(deliverables=made, config=self.config, slam=slam)
        self.loop: Any = SimpleNamespace(latest=None, dive_run=run, maps=maps)
        self.parts: Any = SimpleNamespace(slam=slam, loop=self.loop)
        self.live = LiveCoverage(Failures(), cpu_s=lambda: 0.0)
        self.live.show(self.loop)
        self.pictures = 0

    def _inspect(self, name: str, job: Callable[[Any, Any], None]) -> None:
        water = None
        if self.attenuation is not None:
            water = SimpleNamespace(beta_a=SimpleNamespace())
        job(SimpleNamespace(mappers={0: _Mapper(water, self.attenuation)}), [])

    def swim(self, x: float, y: float, z: float = ALTITUDE, every_s: float = 0.5) -> None:
        """One picture, which becomes a keyframe."""
        shape = (CAMERA.height, CAMERA.width)
        rho, variance = np.full(shape, 1.0 / z), np.full(shape, 1e-6)
        self.keyframes.append(SimpleNamespace(
            number=len(self.keyframes), sub_map=0, T_wc=above(x, y, z),
            pointmap=Pointmap(CAMERA, rho, variance),
        ))  # fmt: skip
        self.pictures += 1
        frame = SimpleNamespace(t_ns=round(1e9 * every_s * self.pictures))
        self.loop.latest = SimpleNamespace(frame=frame, sub_map=0, T_wc=above(x, y, z))
        self.live.update(self.loop)

    def close(self) -> None:
        self.live.close()


class _Mapper:
    """One whose water attenuates so much, every channel alike."""

    def __init__(self, water: Any, attenuation: float | None) -> None:
        import torch

        if water is not None and attenuation is not None:
            water.beta_a = torch.full((3,), attenuation)
        self.scene, self.views = SimpleNamespace(water=lambda view: water), [None]
