"""Which views see a point of the ground, and how well they say where it is.

A view sees a point that its picture holds, at about the range that the map has there from the view:
what lies behind something else, or stands in the water that the view looks through, it does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import scratch_array
from aquaflow.dive.shown_views import OPEN, solid_ranges
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.mapper import Mapper
from aquaflow.render.views import View, in_time
from aquaflow.survey.export.ortho.ground import Ground

Array = npt.NDArray[np.float64]

STRIDE_PX = 2
"""Ranges are kept of every second pixel: 65 kB a view of 480 x 270."""
SAME_RANGE = 0.05
"""Relative difference up to which two ranges are of one surface: rendered ranges err by 1 to 3 %
(notes/2026-11-benchmarks.md), and steps of relief below it hide nothing worth the name."""
FAR = 3.0
"""Times the median range beyond which what a view shows does not widen the raster: there it is
drawn from a ninth of the pixels."""
PICTURE_SIGMA_PX = 1.0
"""1 sigma of where a view shows a point: match, refined pose and calibration together, as the scale
bars take it (dive/scale_bar.py)."""


@dataclass(frozen=True)
class PointSightings:
    """Sightings of some points, by all views."""

    count: npt.NDArray[np.int32]
    """[M] views that see the point."""
    sigma: Array
    """[M] 1 sigma of the height that rays of PICTURE_SIGMA_PX leave open where they meet, in the
    ground's unit; NaN of what fewer than two views see."""
    nearest: Array
    """[M] range from the nearest of them, in the ground's unit; infinite of what none sees."""


class ViewRanges:
    """What each view of a map shows: ranges, in a file that ends with the object."""

    def __init__(
        self,
        mapper: Mapper,
        ground: Ground,
        work: Path,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Draws every view once; the file is made in the folder ``work``, which is made if needed.

        Raises:
            InputError: the views show nothing, or the file cannot be written.
        """
        self._views: list[View] = in_time(mapper.views)
        self._poses: list[Sim3] = [ground.pose(view.T_wc) for view in self._views]
        sizes = [self._size(view) for view in self._views]
        self._starts = np.concatenate([[0], np.cumsum([rows * columns for rows, columns in sizes])])
        self._all = scratch_array(work, (int(self._starts[-1]),), np.float16)
        for number, view in enumerate(self._views):
            z = solid_ranges(mapper, view)[::STRIDE_PX, ::STRIDE_PX]
            self._of(number)[:] = np.where(z == OPEN, OPEN, z * ground.T_gm.scale)
            if progress is not None:
                progress(number + 1, len(self._views))
        self._survey()

    @staticmethod
    def _size(view: View) -> tuple[int, int]:
        """Rows and columns of the ranges that are kept."""
        return -(-view.camera.height // STRIDE_PX), -(-view.camera.width // STRIDE_PX)

    def _of(self, number: int) -> npt.NDArray[np.float16]:
        """[rows, columns] ranges of a view, 0 where the map is not solid, OPEN where it shows open
        water; to be written, too."""
        part = self._all[self._starts[number] : self._starts[number + 1]]
        return part.reshape(self._size(self._views[number]))

    def _survey(self) -> None:
        ranges = (self._of(number) for number in range(len(self._views)))
        medians = [float(np.median(z[z > 0])) for z in ranges if (z > 0).any()]
        if not medians:
            raise InputError("the dive's views show nothing of its map; map the dive again")
        self.median_range = float(np.median(medians))
        """In the ground's unit, of all views."""
        count = len(self._views)
        self._low, self._high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
        footprints = []
        for number, view in enumerate(self._views):
            points, depths = self._points(number)
            if len(points):
                self._low[number] = points[:, :2].min(axis=0)
                self._high[number] = points[:, :2].max(axis=0)
                footprints.append(float(np.median(depths)) / view.camera.fx)
        self.low, self.high = self._low.min(axis=0), self._high.max(axis=0)
        """[2] x, y that hold what the views show, in the ground's unit."""
        self.footprint = float(np.median(footprints))
        """Side of a picture's pixel on what it shows, median, in the ground's unit."""

    def _points(self, number: int) -> tuple[Array, Array]:
        """Ground points [M, 3] that a view shows, and their depths [M] in its camera."""
        view, T_gc = self._views[number], self._poses[number]
        z = self._of(number).astype(np.float64)
        rays = view.camera.unproject(view.camera.pixel_centres()[::STRIDE_PX, ::STRIDE_PX])
        depths = z / np.linalg.norm(rays, axis=-1)
        near = (z > 0.0) & (z < FAR * self.median_range)
        return T_gc.apply(rays[near] * depths[near][:, None]), depths[near]

    def see(
        self,
        points: Array,  # [M, 3] on the ground
    ) -> PointSightings:
        """Which views see ``points``."""
        count = np.zeros(len(points), np.int32)
        information = np.zeros((len(points), 3, 3))
        nearest = np.full(len(points), np.inf)
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        around = ((self._low <= high) & (self._high >= low)).all(axis=1)
        for number in np.flatnonzero(around).tolist():
            seen, directions, ranges = self._seen_by(number, points)
            count[seen] += 1
            nearest[seen] = np.minimum(nearest[seen], ranges)
            sigma = PICTURE_SIGMA_PX / self._views[number].camera.fx * ranges
            information[seen] += ray_information(directions, sigma)
        return PointSightings(count, _height_sigma(information, count), nearest)

    def hold(
        self,
        points: Array,  # [M, 3] on the ground
        margin_px: float = 0.0,
    ) -> npt.NDArray[np.int32]:
        """[M] how many views show the place of each point, ``margin_px`` inside their edges.

        Unlike :meth:`see` this asks nothing of the map at the point, only that it has nothing
        before it, no open water behind it, and that the view shows something as far away: a place
        that was filmed and not mapped is held.
        """
        count = np.zeros(len(points), np.int32)
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        size = self._high - self._low
        around = ((self._low - size <= high) & (self._high + size >= low)).all(axis=1)
        for number in np.flatnonzero(around).tolist():
            z = self._of(number)
            inside, rows, columns, ranges = self._project(number, points, margin_px)
            shown = z[rows, columns]
            hidden = (shown != 0.0) & (ranges > (1.0 + SAME_RANGE) * shown)
            farthest = min(float(z.max()), FAR * self.median_range)
            count[inside[~hidden & (ranges <= farthest)]] += 1
        return count

    def _project(
        self,
        number: int,
        points: Array,  # [M, 3] on the ground
        margin_px: float = 0.0,
    ) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], npt.NDArray[np.intp], Array]:
        """Numbers [K] of the points within a view's picture, rows and columns [K] of their kept
        ranges, and how far they are [K]."""
        view, T_gc = self._views[number], self._poses[number]
        camera = view.camera
        local = (points - T_gc.t) @ T_gc.R
        ahead = np.flatnonzero(local[:, 2] > 0.0)
        u, v = camera.project(local[ahead]).T
        # The outermost column stands for what a negative margin adds.
        inside = (u >= margin_px) & (u < camera.width - margin_px)
        inside &= (v >= margin_px) & (v < camera.height - margin_px)
        most = self._size(view)
        rows, columns = (
            np.clip(np.floor(each[inside] / STRIDE_PX), 0, side - 1).astype(np.intp)
            for each, side in zip((v, u), most, strict=True)
        )
        ahead = ahead[inside]
        return ahead, rows, columns, np.linalg.norm(points[ahead] - T_gc.t, axis=1)

    def _seen_by(
        self,
        number: int,
        points: Array,  # [M, 3] on the ground
    ) -> tuple[npt.NDArray[np.intp], Array, Array]:
        """Numbers [K] of the points that a view sees, unit vectors [K, 3] to them, ranges [K]."""
        inside, rows, columns, ranges = self._project(number, points)
        offset = points[inside] - self._poses[number].t
        z = self._of(number)
        same = np.abs(z[rows, columns] - ranges) <= SAME_RANGE * ranges
        return inside[same], offset[same] / ranges[same][:, None], ranges[same]


def ray_information(
    directions: Array,  # [K, 3] unit
    sigma: Array,  # [K]
) -> Array:
    """[K, 3, 3] of the places of points, from rays that are each known to ``sigma`` across."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    return np.asarray(across / (sigma**2)[:, None, None])


def _height_sigma(
    information: Array,  # [M, 3, 3] of the points' places, ground
    count: npt.NDArray[np.int32],  # [M]
) -> Array:
    """[M] 1 sigma of the height; NaN where fewer than two views see the point."""
    sigma = np.full(len(count), np.nan)
    several = count >= 2
    found = information[several]
    across, along = found[:, :2, :2], found[:, :2, 2]
    # What the height is known by once its place in the plane is found with it (Schur complement).
    solved = np.linalg.solve(across, along[..., None])[..., 0]
    left = found[:, 2, 2] - np.einsum("mi,mi->m", along, solved)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma[several] = 1.0 / np.sqrt(np.maximum(left, 0.0))
    return np.where(np.isfinite(sigma), sigma, np.nan)
