"""The frame of a sub-map from its camera path and the vehicle's telemetry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.config import FusionConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.telemetry.building import problem_of
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.confirmation import confirmation_of
from aquaflow.telemetry.contradictions import contradiction_in
from aquaflow.telemetry.device_clocks import DeviceClocks
from aquaflow.telemetry.factors.factor import Factor
from aquaflow.telemetry.problem import Carried, TelemetryProblem
from aquaflow.telemetry.solution_frame import frame_of
from aquaflow.telemetry.solve import Solution, solve
from aquaflow.telemetry.start import camera_in_body
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import SourceReport, WorldFrame

Array = npt.NDArray[np.float64]

LEAST_POSES = 5
"""Of a sub-map; a shorter one gets no frame of its own."""


@dataclass(frozen=True)
class Estimate:
    """The frame of a sub-map, and how it came about."""

    frame: WorldFrame
    problem: TelemetryProblem | None = None
    solution: Solution | None = None
    """None where no telemetry could be used."""

    def reporting(self, sources: Sequence[SourceReport]) -> Estimate:
        """The same with reports of further sources, which could not be used."""
        return replace(self, frame=replace(self.frame, sources=(*self.frame.sources, *sources)))


def estimate(
    telemetry: Telemetry,
    path: CameraPath,
    config: FusionConfig,
    mounting: MountingConfig | None,
    points: Callable[[], Array],
    extra: Sequence[Factor] = (),
    carried: Carried | None = None,
) -> Estimate:
    """The frame of the sub-map with ``path``.

    Args:
        mounting: of the camera in the body, as stated; None if nobody stated it.
        points: makes the map's points [K, 3] m, for the altimeter's beam.
        extra: factors that do not come from telemetry: known lengths.
        carried: what an earlier sub-map of the dive has shown.

    Raises:
        ArithmeticError: the residuals are not finite.
    """
    if len(path) < LEAST_POSES:
        return Estimate(WorldFrame.unknown(f"the sub-map has only {len(path)} poses"))
    if not telemetry and not extra:
        return Estimate(WorldFrame.unknown())
    R_cb = None if mounting is None else camera_in_body(mounting).R.T
    clocks = DeviceClocks.of(telemetry, path, R_cb)
    telemetry = clocks.correct(telemetry)
    rejected = clocks.unlike(telemetry)

    def problem_along(path: CameraPath, points: Callable[[], Array]) -> TelemetryProblem:
        return problem_of(telemetry, path, config, mounting, points, carried, extra, rejected)

    while True:
        problem = problem_along(path, points)
        if not problem.factors:
            unused = WorldFrame.unknown("no telemetry could be used")
            return Estimate(replace(unused, sources=tuple(problem.reports)))
        solution = solve(problem.factors, problem.start, problem.prior)
        wrong = contradiction_in(problem, solution)
        if wrong is None:
            break
        rejected[wrong.source, wrong.kind] = SourceReport(
            wrong.source, wrong.kind, rejected=wrong.samples, reason=wrong.reason
        )
    unconfirmed = ""
    if clocks.leave_open(problem):
        ground = points()
        confirmation = confirmation_of(path, lambda part: problem_along(part, lambda: ground))
        if confirmation.vague:
            unconfirmed = f"not confirmed: {confirmation.in_words()}, and {clocks.why_open}"
        elif confirmation.refuted or not clocks.known:
            solution = confirmation.apply(solution)
            problem.doubt = f"{confirmation.in_words()}, and {clocks.why_open}"
    frame = frame_of(problem, solution, path)
    if unconfirmed and frame.metric:
        said = f"{frame.scale_source}; {unconfirmed}"
        frame = replace(frame, scale_confirmed=False, scale_source=said)
    return Estimate(clocks.with_clocks(frame), problem, solution)
