"""The reef numbers of a dive: of a finished one, or of one whose maps are still in memory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from aquaflow.base.clocks.deadline import Deadline
from aquaflow.base.errors import InputError, reason_of
from aquaflow.dive.dive import Dive
from aquaflow.dive.medium import NAME as MEDIUM
from aquaflow.survey.export.ortho.ground import Ground, ground_of
from aquaflow.survey.measure.height_field import HeightField
from aquaflow.survey.measure.quantity import scale_of
from aquaflow.survey.measure.reef_numbers import DiveWater, ReefNumbers, reef_numbers

if TYPE_CHECKING:
    from aquaflow.mapping.mapper import Mapper
    from aquaflow.survey.measure.drawn_heights import Progress


def numbers_of_dive(
    dive: Dive, work: Path, cell: float | None = None, progress: Progress | None = None
) -> ReefNumbers:
    """The numbers of a finished dive's largest sub-map.

    Args:
        work: folder of a file that ends with the call.
        cell: side of the cells; None: found from the map's resolution.

    Raises:
        InputError: the dive has no map, or a file of it is damaged.
        ConfigError: the dive's settings cannot be read.
    """
    mapper = dive.filled_map()
    dive.require(MEDIUM)

    def draw() -> tuple[HeightField, Ground]:
        return _draw(dive, mapper, work, cell, progress)

    return reef_numbers(draw, _places(dive), _water(dive), scale_of(dive.frame))


def numbers_at_the_end(dive: Dive, until: Deadline) -> ReefNumbers:
    """The numbers of the largest sub-map of a dive that ends, with what is in memory; after
    ``until`` the ground is left out."""

    def in_time(stage: str, done: int, total: int) -> None:
        if until.over:
            raise InputError(
                f"the dive's end had no more time after {done} of {total} {stage} "
                "(service.finish_s); aquaflow measure does it"
            )

    def draw() -> tuple[HeightField, Ground]:
        mapper = dive.maps.get(dive.main)
        if mapper is None or not mapper.views or len(mapper.gaussians) == 0:
            raise InputError("the map is empty; map a recording that shows more")
        in_time("views", 0, len(mapper.views))
        return _draw(dive, mapper, dive.path, None, in_time)

    return reef_numbers(draw, _places(dive), _water(dive), scale_of(dive.frame))


def _draw(
    dive: Dive, mapper: Mapper, work: Path, cell: float | None, progress: Progress | None
) -> tuple[HeightField, Ground]:
    from aquaflow.dive.shown_views import ShownViews  # loads torch
    from aquaflow.survey.measure.drawn_heights import draw_heights

    ground = ground_of(dive.frame, mapper)
    return draw_heights(ShownViews(mapper), ground, work, cell, progress), ground


def _places(dive: Dive) -> npt.NDArray[np.float64]:
    """[N, 3] camera centres in n, in order of time."""
    rows = [row for row in dive.poses if row.sub_map == dive.main]
    return np.array([(row.x, row.y, row.z) for row in rows]).reshape(-1, 3)


def _water(dive: Dive) -> DiveWater | None:
    facts = dive.medium_facts
    try:
        if not facts or not facts["active"]:
            return None
        rates = [float(each) for each in facts["attenuation_per_unit"]]
        sigma = facts["attenuation_relative_sigma"]
        return DiveWater(rates, None if sigma is None else [float(each) for each in sigma])
    except (ValueError, KeyError, TypeError) as error:
        path = dive.file(MEDIUM)
        raise InputError(f"cannot read {path}: {reason_of(error)}; map the dive again") from error
