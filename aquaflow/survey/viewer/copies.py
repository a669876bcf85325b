"""The live viewer's copy of a dive, made by threads that have no time for browsers.

The loop and the mapping thread put new data into queues of one; a thread of the viewer takes
it from there, computes what a browser needs, and hands it to the server.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.coverage.plan import CoveragePlan
from aquaflow.survey.viewer.dive_coverage import CLASSES, COVERAGE
from aquaflow.survey.viewer.levels import RANGE, Palette, range_level, steps_level
from aquaflow.survey.viewer.measuring import Frame
from aquaflow.survey.viewer.seen_water import SeenWater, seen_water
from aquaflow.survey.viewer.splats import Splats, splats
from aquaflow.telemetry.metric_frame import MetricFrame
from aquaflow.types import CameraModel

if TYPE_CHECKING:
    from aquaflow.mapping.map_copy import MapCopy  # it loads torch

SEEN = "seen"
"""Name of the level that says how often a Gaussian was seen."""
OFTEN = 200.0
"""Steps of the optimiser after which a Gaussian counts as seen as often as can be."""


@dataclass(frozen=True)
class Pose:
    """Where the camera is, and what it sees."""

    T_wc: Sim3
    camera: CameraModel
    picture: npt.NDArray[np.uint8]
    """[H, W, 3] RGB"""


def shown(
    copy: MapCopy, budget: int, frame: Frame | None = None, plan: CoveragePlan | None = None
) -> tuple[Splats, SeenWater | None, dict[str, Palette]]:
    """In the viewer's thread: what a browser gets, the water before it, and the palettes of what
    each Gaussian is coloured by: how often it was seen, from how far away, and, by the ``plan`` of
    its sub-map's coverage, how well."""
    plain, water, unit = copy.parameters, _water(copy), frame or Frame.of(MetricFrame.unknown())
    with np.errstate(over="ignore"):
        opacities = (1.0 / (1.0 + np.exp(-plain["opacity_logits"][:, 0]))).astype(np.float32)
        scales = np.exp(plain["log_scales"])
    often, palette = steps_level(copy.steps, OFTEN)
    chosen = splats(
        plain["means"], plain["quats"], scales, opacities, copy.clear, budget, {SEEN: often}
    )
    cameras = np.array([T_wc.t for T_wc in copy.views])
    ranges, range_palette = range_level(chosen.centres, cameras, unit.scale.unit, unit.metres)
    levels, palettes = chosen.levels | {RANGE: ranges}, {SEEN: palette, RANGE: range_palette}
    if plan is not None:
        levels[COVERAGE] = plan.classes_of(chosen.centres.astype(np.float64))
        palettes[COVERAGE] = CLASSES
    return replace(chosen, levels=levels), water, palettes


def _water(copy: MapCopy) -> SeenWater | None:
    """None where there is none, or none that can be shown yet."""
    if copy.water is None or not len(copy.parameters["means"]):
        return None
    away = np.linalg.norm(copy.parameters["means"] - copy.views[-1].t, axis=1)
    try:
        beta, B_inf, b, B_res, d, gain = copy.water
        return seen_water(beta, B_inf, b, B_res, d, gain, float(np.median(away)))
    except ValueError:
        return None
