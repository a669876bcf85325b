"""The reef numbers of a finished dive, from the files in its folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aquaflow.base.errors import InputError, reason_of
from aquaflow.base.errors.regular_file import read_regular_json
from aquaflow.dive.trajectory_csv import NAME as TRAJECTORY
from aquaflow.dive.trajectory_csv import read_trajectory_csv
from aquaflow.survey.export.ortho.ground import Ground, ground_of
from aquaflow.survey.export.ortho.survey import read_map
from aquaflow.survey.measure.drawn_heights import Progress, draw_heights
from aquaflow.survey.measure.height_field import HeightField
from aquaflow.survey.measure.reef_numbers import ReefNumbers, Water, reef_numbers
from aquaflow.survey.measure.scale import scale_of
from aquaflow.telemetry.metric_file import read_main


def numbers_of_dive(
    dive: Path, work: Path, cell: float | None = None, progress: Progress | None = None
) -> ReefNumbers:
    """The numbers of a finished dive's largest sub-map.

    Args:
        work: folder of a file that ends with the call.
        cell: side of the cells; None: found from the map's resolution.

    Raises:
        InputError: the dive has no map, or a file of it is damaged.
        ConfigError: the dive's settings cannot be read.
    """
    mapper, frame = read_map(dive)
    main = read_main(dive)

    def draw() -> tuple[HeightField, Ground]:
        ground = ground_of(frame, mapper.views)
        return draw_heights(mapper, ground, work, cell, progress), ground

    rows = [row for row in read_trajectory_csv(dive / TRAJECTORY) if row.sub_map == main]
    places = np.array([(row.x, row.y, row.z) for row in rows]).reshape(-1, 3)
    return reef_numbers(draw, places, _water(dive / "medium.json"), scale_of(frame))


def _water(path: Path) -> Water | None:
    try:
        data = read_regular_json(path)
        if not data["active"]:
            return None
        rates = [float(each) for each in data["attenuation_per_unit"]]
        sigma = data["attenuation_relative_sigma"]
        return Water(rates, None if sigma is None else [float(each) for each in sigma])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}; map the dive again") from error
