"""Gaussians coloured by how well the place above or below them was seen:
:mod:`aquaflow.survey.coverage` says it, of a finished dive by its file, of a live one by
its plan of the moment."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.survey.coverage.classes import COLOURS, WORDS, CoverageClass
from aquaflow.survey.coverage.coverage_file import NAME, read_coverage_file
from aquaflow.survey.viewer.levels import Palette
from aquaflow.telemetry.world_frame import WorldFrame

log = logging.getLogger(__name__)

COVERAGE = "coverage"
"""Name of the level."""
UNSEEN = (60, 60, 66)
"""RGB of what was not seen: dark, as it is missing."""
CLASSES = Palette(
    "by coverage",
    tuple(COLOURS.get(seen, UNSEEN) for seen in CoverageClass),
    tuple(WORDS[seen] for seen in CoverageClass),
)


def coverage_of_dive(
    dive: Dive,
    centres: npt.NDArray[np.floating],  # [N, 3] in n
    frame: WorldFrame,
) -> npt.NDArray[np.uint8] | None:
    """[N] a :class:`aquaflow.survey.coverage.Seen` for each; None where the dive keeps no
    coverage."""
    if not dive.has(NAME):
        return None
    try:
        view = read_coverage_file(dive.file(NAME)).get(dive.main)
    except InputError as error:
        log.warning("the viewer shows no coverage: %s", error)
        return None
    if view is None:
        return None
    T_mn = frame.T_nm.inverse()
    return view.plan.classes_of(T_mn.apply(np.nan_to_num(centres).astype(np.float64)))
