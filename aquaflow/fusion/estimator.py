"""The frame of a sub-map from its camera path and the vehicle's telemetry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from aquaflow.config import FusionConfig
from aquaflow.config.telemetry import MountingConfig
from aquaflow.fusion.camera_path import CameraPath
from aquaflow.fusion.factors.factor import Factor
from aquaflow.fusion.metric_frame import MetricFrame, Origin
from aquaflow.fusion.problem import problem_of
from aquaflow.fusion.solution_frame import frame_of
from aquaflow.fusion.solve import Solution, solve
from aquaflow.fusion.telemetry import Telemetry

Array = npt.NDArray[np.float64]

LEAST_POSES = 5
"""Of a sub-map; a shorter one gets no frame of its own."""


def estimate(
    telemetry: Telemetry,
    path: CameraPath,
    config: FusionConfig,
    mounting: MountingConfig | None,
    points: Callable[[], Array],
    extra: Sequence[Factor] = (),
    origin: Origin | None = None,
) -> tuple[MetricFrame, Solution | None]:
    """The frame of the sub-map with ``path``.

    Args:
        mounting: of the camera in the body, as stated; None if nobody stated it.
        points: makes the map's points [K, 3] m, for the altimeter's beam.
        extra: factors that do not come from telemetry: known lengths, a dead-reckoned start.
        origin: of n, where another sub-map already has one.

    Raises:
        ArithmeticError: the residuals are not finite.
    """
    if len(path) < LEAST_POSES:
        return MetricFrame.unknown(f"the sub-map has only {len(path)} poses"), None
    if not telemetry and not extra:
        return MetricFrame.unknown(), None
    problem = problem_of(telemetry, path, config, mounting, points, origin)
    problem.factors += extra
    if not problem.factors:
        unused = MetricFrame.unknown("no telemetry could be used")
        return replace(unused, sources=tuple(problem.reports)), None
    solution = solve(problem.factors, problem.start, problem.prior)
    return frame_of(problem, solution, path), solution
