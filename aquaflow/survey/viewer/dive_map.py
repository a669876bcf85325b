"""The Gaussians of a finished dive, with what they are coloured by: seconds for half a million."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import read_ply
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.coverage.classes import COLOURS, WORDS, CoverageClass
from aquaflow.survey.coverage.coverage_file import NAME, read_coverage_file
from aquaflow.survey.viewer.floaters import find_floaters
from aquaflow.survey.viewer.levels import RANGE, Palette, range_level
from aquaflow.survey.viewer.splats import ViewerSplats, splats
from aquaflow.telemetry.world_frame import WorldFrame


@dataclass(frozen=True)
class DiveMap:
    """What is shown of a map."""

    splats: ViewerSplats
    palettes: dict[str, Palette]
    total: int
    """Gaussians of the whole map."""


def read_map(
    dive: Dive,
    ply: Path,
    poses: Sequence[Sim3],  # of the path
    frame: WorldFrame,
    budget: int,
) -> DiveMap:
    """The Gaussians in ``ply``, at most ``budget``, of ``dive``.

    Raises:
        InputError: the file cannot be read.
    """
    gaussians = read_ply(ply)
    cameras = np.array([pose.t for pose in poses]).reshape(-1, 3)
    levels, palettes = _levels(gaussians.means, cameras, frame.unit)
    classes = coverage_of_dive(dive, gaussians.means, frame)
    if classes is not None:
        levels[COVERAGE], palettes[COVERAGE] = classes, CLASSES
    shown = splats(
        np.asarray(gaussians.means, np.float32), np.asarray(gaussians.wxyz, np.float32),
        np.asarray(gaussians.scales, np.float32), np.asarray(gaussians.opacities, np.float32),
        np.asarray(gaussians.colours, np.float32), budget, levels,
        find_floaters(gaussians, poses, dive.camera),
    )  # fmt: skip
    return DiveMap(shown, palettes, len(gaussians.means))


def _levels(
    means: npt.NDArray[np.floating],  # [N, 3]
    cameras: npt.NDArray[np.float64],  # [M, 3]
    unit: str,
) -> tuple[dict[str, npt.NDArray[np.uint8]], dict[str, Palette]]:
    if not len(cameras) or not len(means):
        return {}, {}
    values, palette = range_level(means, cameras, unit)
    return {RANGE: values}, {RANGE: palette}


# --------------------------------------------------------------------------------------------------
# Gaussians coloured by how well the place above or below them was seen:
# :mod:`aquaflow.survey.coverage` says it, of a finished dive by its file, of a live one by
# its plan of the moment.

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
    """[N] a the coverage for each; None where the dive keeps no
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
