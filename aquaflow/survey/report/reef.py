"""The reef numbers at the end of a dive, from the map that is still in memory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors import InputError
from aquaflow.dive.from_maps import drawn_ground
from aquaflow.dive.results import WaterSummary
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.export.ortho.ground import Ground
from aquaflow.survey.measure.height_field import HeightField
from aquaflow.survey.measure.reef_numbers import ReefNumbers, Water, reef_numbers
from aquaflow.survey.measure.scale import scale_of
from aquaflow.telemetry.metric_frame import MetricFrame

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper


def numbers_at_the_end(
    mapper: Mapper | None,
    frame: MetricFrame,
    poses: list[Sim3],
    water: WaterSummary | None,
    work: Path,
    until: Deadline | None = None,
) -> ReefNumbers:
    """Of the largest sub-map.

    Args:
        mapper: None: nothing was mapped.
        poses: T_nc of its frames in order of time.
        water: in the unit of ``frame``.
        work: folder of a file that ends with the call.
        until: when the ground is left out; None: never.
    """

    def in_time(stage: str, done: int, total: int) -> None:
        if until is not None and until.over:
            raise InputError(
                f"the dive's end had no more time after {done} of {total} {stage} "
                "(service.finish_s); aquaflow measure does it"
            )

    def draw() -> tuple[HeightField, Ground]:
        if mapper is None or not mapper.views or len(mapper.gaussians) == 0:
            raise InputError("the map is empty; map a recording that shows more")
        return drawn_ground(mapper, frame, work, in_time)

    places = np.array([T_nc.t for T_nc in poses]).reshape(-1, 3)
    known = None if water is None else Water(water.beta_a, water.beta_a_sigma)
    return reef_numbers(draw, places, known, scale_of(frame))
