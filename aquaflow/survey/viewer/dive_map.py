"""The Gaussians of a finished dive, with what they are coloured by: seconds for half a million."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.ply import PlyFile
from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.coverage.classes import COLOURS, WORDS, CoverageClass
from aquaflow.survey.coverage.coverage_file import NAME, read_coverage_file
from aquaflow.survey.coverage.plan import CoveragePlan
from aquaflow.survey.viewer.floaters import find_floaters
from aquaflow.survey.viewer.levels import RANGE, Palette, RangeLevel
from aquaflow.survey.viewer.map_tiles import BASE, LEAST_BUDGET, MapTiles, shown_rows
from aquaflow.survey.viewer.packing import Packed
from aquaflow.survey.viewer.splats import Float, ViewerSplats, growth, splats, weights
from aquaflow.telemetry.world_frame import WorldFrame

CHUNK = 1 << 16
"""Gaussians that are read at a time; some 10 MB."""


class DiveMap:
    """What is shown of a map."""

    def __init__(
        self,
        read: Callable[[], ViewerSplats],
        palettes: dict[str, Palette],
        total: int,
        at_once: int | None = None,
        pack: Callable[[], Packed] | None = None,
    ) -> None:
        """``read``: Gaussians for who points at them, as many as are shown at once; ``total``: of
        the whole map; ``at_once`` and ``pack``: of one that has more than are shown at once."""
        self._read, self.palettes, self.total = read, palettes, total
        self._at_once, self._pack = at_once, pack

    @cached_property
    def splats(self) -> ViewerSplats:
        """As many as are shown at once, those that cover most; read when first asked for."""
        return self._read()

    @cached_property
    def packed(self) -> Packed:
        """What browsers get."""
        return Packed(self.splats) if self._pack is None else self._pack()

    @property
    def at_once(self) -> int:
        """Gaussians that a browser shows at most."""
        return len(self.splats) if self._at_once is None else self._at_once


def read_map(
    dive: Dive,
    ply: Path,
    poses: Sequence[Sim3],  # of the path
    frame: WorldFrame,
    budget: int,
) -> DiveMap:
    """The Gaussians in ``ply``, at most ``budget`` at once, of ``dive``; with tiles where it has
    more, unless so few are asked for that the largest of all do.

    Raises:
        InputError: the file cannot be read.
    """
    file = PlyFile(ply)
    cameras = np.array([pose.t for pose in poses]).reshape(-1, 3)
    if len(file) > budget >= LEAST_BUDGET:
        return _tiled_map(dive, file, cameras, frame, budget)
    gaussians = file.rows(slice(None))
    levels = MapLevels(dive, gaussians.means, cameras, frame)
    shown = splats(
        np.asarray(gaussians.means, np.float32), np.asarray(gaussians.wxyz, np.float32),
        np.asarray(gaussians.scales, np.float32), np.asarray(gaussians.opacities, np.float32),
        np.asarray(gaussians.colours, np.float32), budget, levels.of(gaussians.means),
        find_floaters(gaussians, poses, dive.camera),
    )  # fmt: skip
    return DiveMap(lambda: shown, levels.palettes, len(file))


def _tiled_map(
    dive: Dive,
    file: PlyFile,
    cameras: npt.NDArray[np.float64],  # [M, 3] of the path
    frame: WorldFrame,
    budget: int,
) -> DiveMap:
    """A map of which memory never holds all; nothing of it counts as floating."""
    means, weight = _read_weights(file)
    order = np.argsort(-weight, kind="stable")
    chosen = order[weight[order] >= 0.0][:budget]
    total = float(np.maximum(weight, 0.0).sum())
    levels = MapLevels(dive, means[chosen[:BASE]], cameras, frame)

    def grown(rows: npt.NDArray[np.intp]) -> float:
        return growth(float(weight[rows].sum()) / max(total, 1e-12))

    def pack() -> Packed:
        base = chosen[:BASE]
        shown = shown_rows(file, base, grown(base), levels.of)
        return Packed(shown, MapTiles(file, means, weight, shown, levels.of, budget))

    return DiveMap(
        lambda: shown_rows(file, chosen, grown(chosen)), levels.palettes, len(file), budget, pack
    )


def _read_weights(file: PlyFile) -> tuple[Float, Float]:
    """Centres [N, 3] of all Gaussians, and what each covers [N]; negative of what is not finite."""
    means, weight = np.zeros((len(file), 3), np.float32), np.zeros(len(file), np.float32)
    for first in range(0, len(file), CHUNK):
        part = slice(first, first + CHUNK)
        rows = file.rows(part)
        numbers = (rows.means, rows.wxyz, rows.scales, rows.opacities[:, None], rows.colours)
        finite = np.isfinite(np.hstack(numbers)).all(axis=1)
        scales = np.where(finite[:, None], rows.scales, 0.0).astype(np.float32)
        opacities = np.where(finite, rows.opacities, 0.0).astype(np.float32)
        means[part] = rows.means
        weight[part] = np.where(finite, weights(opacities, scales), np.float32(-1.0))
    return means, weight


class MapLevels:
    """By what the Gaussians of a dive can be coloured."""

    def __init__(
        self,
        dive: Dive,
        means: npt.NDArray[np.floating],  # [N, 3] of those by which the palettes are chosen
        cameras: npt.NDArray[np.float64],  # [M, 3] of the path
        frame: WorldFrame,
    ) -> None:
        self.palettes: dict[str, Palette] = {}
        self._levels: dict[str, Callable[[Float], npt.NDArray[np.uint8]]] = {}
        if len(cameras) and len(means):
            ranges = RangeLevel(means, cameras, frame.unit)
            self.palettes[RANGE], self._levels[RANGE] = ranges.palette, ranges.of
        plan = plan_of_dive(dive)
        if plan is not None:
            self.palettes[COVERAGE] = CLASSES
            self._levels[COVERAGE] = partial(classes_in, plan, frame)

    def of(
        self,
        means: npt.NDArray[np.floating],  # [N, 3]
    ) -> dict[str, npt.NDArray[np.uint8]]:
        """[N] values of each level, by name."""
        return {name: level(np.asarray(means, np.float32)) for name, level in self._levels.items()}


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
    """[N] the coverage at each; None where the dive keeps no coverage."""
    plan = plan_of_dive(dive)
    return None if plan is None else classes_in(plan, frame, centres)


def plan_of_dive(dive: Dive) -> CoveragePlan | None:
    """What of its ground the camera has seen; None where the dive keeps no coverage."""
    if not dive.has(NAME):
        return None
    try:
        view = read_coverage_file(dive.file(NAME)).get(dive.main)
    except InputError as error:
        log.warning("the viewer shows no coverage: %s", error)
        return None
    return None if view is None else view.plan


def classes_in(
    plan: CoveragePlan,
    frame: WorldFrame,
    centres: npt.NDArray[np.floating],  # [N, 3] in n
) -> npt.NDArray[np.uint8]:
    """[N] the class of the cell that each lies in."""
    T_mn = frame.T_nm.inverse()
    return plan.classes_of(T_mn.apply(np.nan_to_num(centres).astype(np.float64)))
