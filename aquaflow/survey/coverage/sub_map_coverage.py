"""What the camera has seen of one sub-map: it grows by keyframes, and follows those that move.

A keyframe costs the same however long the dive is: what it sees is drawn into a grid once, and once
more when its pointmap is final. When keyframes move, at most ``REDRAWN`` of them are drawn anew in
each turn, those that moved furthest first; what moved by less than a fraction of a cell waits for
:meth:`SubMapCoverage.settle`. The grid is in map units, so that another scale changes nothing in
it. It is made anew, beside the one that is shown, in turns of the same size, where the page turns
(gravity was found), where the unit has changed, or where it has too many tiles.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.survey.coverage.footprint import Footprint
from aquaflow.survey.coverage.plan import CoverageLayer, Sight
from aquaflow.survey.coverage.raster import GridFrame

Array = npt.NDArray[np.float64]

REDRAWN = 32
"""Keyframes that are drawn anew in a turn: 20 to 60 ms of CPU time."""
MOST_TILES = 8192
"""Of a grid: 86 MB, at 0.1 m a cell 20,000 m^2. Then its cells become twice as large."""
UNMOVED = 0.25
"""Cells by which a keyframe's view may have moved until it is drawn anew: no cell's share that is
seen changes by more."""
TURNED_RAD = float(np.radians(2.0))
"""Turn of the page against the grid from which that is made anew: the ground's relief then shifts
by 3 % of its height."""
JUDGED_AGAIN = 1.1
"""Times as many keyframes until it is judged again whether the grid fits: so a keyframe's share in
that is the same however many there are."""
PROBES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
"""Points on the camera's axis and beside it at the depth 1, camera frame."""
GROWN = 2.0
"""Ratio of the views' size to that which the grid was made for, from which that is made anew."""


class SubMapCoverage:
    """For one thread at a time."""

    def __init__(self, cells: int, R_pm: Array) -> None:  # R_pm: [3, 3] page from the sub-map
        """``cells`` along the shorter side of a view; see :class:`CoverageConfig`."""
        self._cells, self._R_pm = cells, R_pm
        self._seen: dict[int, Sight] = {}
        """Of each keyframe that shows anything, as it is now."""
        self._sizes: dict[int, tuple[float, float]] = {}
        """Of each: median range and shorter side of its view, map units."""
        self._changed: dict[int, float] = {}
        """Keyframes to be drawn, and by how many cells each has moved."""
        self._slightly: set[int] = set()
        self._coarser = 1.0
        self._judged = 0
        """Keyframes when it was last judged whether the grid fits their sizes."""
        self._shown: CoverageLayer | None = None
        self._next: CoverageLayer | None = None

    @property
    def layer(self) -> CoverageLayer | None:
        """The grid that is shown; None until the first keyframe."""
        return self._shown

    @property
    def seen(self) -> Mapping[int, Sight]:
        """What each keyframe has seen, as it is now: footprint and T_mc."""
        return self._seen

    @property
    def settled(self) -> bool:
        """True if the grid shows every keyframe where it is, to a fraction of a cell."""
        return not self._changed and self._next is None

    @property
    def side(self) -> float:
        """Shorter side of what a picture shows, median, map units; 0 before the first one."""
        return float(np.median([side for _, side in self._sizes.values()] or [0.0]))

    def put(self, number: int, footprint: Footprint, T_mc: Sim3) -> None:
        """A keyframe, or what is known of it by now; one that shows nothing is taken out."""
        if not footprint.known or not T_mc.is_finite():
            self.take_out(number)
            return
        self._seen[number] = footprint, T_mc
        self._sizes[number] = _size(footprint, T_mc)
        self._changed[number] = np.inf  # a new one is drawn before those that moved

    def take_out(self, number: int) -> None:
        """A keyframe that went to another sub-map; unknown ones are none."""
        self._seen.pop(number, None)
        self._sizes.pop(number, None)
        self._slightly.discard(number)
        if any(layer and number in layer.drawn for layer in (self._shown, self._next)):
            self._changed[number] = np.inf
        else:
            self._changed.pop(number, None)

    def move(self, poses: Mapping[int, Sim3]) -> None:
        """T_mc of keyframes whose pose is another one than before."""
        numbers = [n for n, T in poses.items() if n in self._seen and T.is_finite()]
        for number in numbers:
            footprint, _ = self._seen[number]
            self._seen[number] = footprint, poses[number]
            self._sizes[number] = _size(footprint, poses[number])
        self._judged = 0
        layer = self._next or self._shown
        drawn = [n for n in numbers if layer is not None and n in layer.drawn]
        if layer is None or not drawn:
            return
        for number, cells in zip(drawn, self._moved_cells(layer, drawn), strict=True):
            if cells <= UNMOVED:
                self._slightly.add(number)
            elif self._changed.get(number) != np.inf:
                self._changed[number] = cells

    def turn(self, R_pm: Array) -> None:  # [3, 3] page from the sub-map's world
        """Another page; the grid is made anew if it differs by more than the eye forgives."""
        self._R_pm = R_pm

    def update(self, most: int = REDRAWN) -> int:
        """One turn: draw what is new or moved, ``most`` keyframes; how many were drawn."""
        self._begin_anew_if_needed()
        layer = self._next or self._shown
        if layer is None:
            return 0
        due = sorted(self._changed, key=lambda n: (-self._changed[n], -n))[:most]
        for number in due:
            cells = self._changed.pop(number)
            layer.draw(number, self._seen.get(number))
            if self._next is not None and self._shown is not None and cells == np.inf:
                self._shown.draw(number, self._seen.get(number))
        if self._next is not None:
            due += self._draw_missing(self._next, most - len(due))
        return len(due)

    def settle(self) -> None:
        """Draw everything where it is, however long that takes."""
        self._changed |= dict.fromkeys(self._slightly, 0.0)
        self._slightly.clear()
        while self.update(len(self._seen) + len(self._changed) + 1):
            pass

    # --- the grid made anew ---------------------------------------------------------------------

    def _begin_anew_if_needed(self) -> None:
        shown = self._shown
        if not self._sizes or self._next is not None:
            return
        if shown is None:
            self._shown = CoverageLayer(self._frame())
            return
        if len(shown.tiles) > MOST_TILES:
            self._coarser *= 2.0
        elif not self._outgrown(shown.frame):
            return
        self._next = CoverageLayer(self._frame())

    def _outgrown(self, frame: GridFrame) -> bool:
        turn = Sim3(self._R_pm @ frame.R_gm.T, np.zeros(3)).log()[3:6]
        if float(np.linalg.norm(turn)) > TURNED_RAD:
            return True
        if len(self._sizes) < JUDGED_AGAIN * self._judged:
            return False
        self._judged, wanted = len(self._sizes), self._frame()
        ratios = (wanted.cell / frame.cell, wanted.reference / frame.reference)
        return max(max(ratio, 1.0 / ratio) for ratio in ratios) > GROWN

    def _frame(self) -> GridFrame:
        ranges, sides = np.median(np.array(list(self._sizes.values())), axis=0)
        cell = self._coarser * float(sides) / self._cells
        return GridFrame(self._R_pm.copy(), cell, float(ranges))

    def _draw_missing(self, layer: CoverageLayer, most: int) -> list[int]:
        """Keyframes of before, newest first; when none is left, the new grid is shown."""
        missing = [n for n in reversed(self._seen) if n not in layer.drawn][: max(most, 0)]
        for number in missing:
            layer.draw(number, self._seen[number])
            self._changed.pop(number, None)
            self._slightly.discard(number)
        if len(layer.drawn) == len(self._seen) and not self._changed:
            self._shown, self._next = layer, None
        return missing

    def _moved_cells(self, layer: CoverageLayer, numbers: list[int]) -> Array:
        """[K] cells by which the view of each has moved since it was drawn: the most of a point on
        the camera's axis and of two beside it."""
        now = Sim3Batch.of([self._seen[n][1] for n in numbers])
        then = Sim3Batch.of([layer.drawn[n][1] for n in numbers])
        depths = np.array([self._seen[n][0].depth for n in numbers])
        probes = depths[:, None, None] * PROBES
        shift = _apply(now, probes) - _apply(then, probes)
        return np.asarray(np.linalg.norm(shift, axis=2).max(axis=1) / layer.frame.cell)


def _apply(
    poses: Sim3Batch,
    points: Array,  # [K, 3, 3] three of each
) -> Array:
    """[K, 3, 3] the points of each in the frame that its pose maps to."""
    turned = np.einsum("kij,kpj->kpi", poses.R, points)
    return np.asarray(poses.scale[:, None, None] * turned + poses.t[:, None, :])


def _size(footprint: Footprint, T_mc: Sim3) -> tuple[float, float]:
    """Median range and the shorter side of what a picture shows at it, map units."""
    camera: CameraModel = footprint.camera
    depth = T_mc.scale * footprint.depth
    return depth, depth * min(camera.width / camera.fx, camera.height / camera.fy)
