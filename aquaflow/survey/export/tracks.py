"""Tracks: points of the scene with the pixels at which several of a dive's pictures show them.

They are what a bundle adjustment works with, and are measured in the pictures alone: keypoints
that match each other, and that one relative pose of two pictures explains. The dive's poses only
place the points; how far the pixels are from where the poses have them is the error of each point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from aquaflow.base.errors import InputError, reason_of
from aquaflow.dive.png import read_png
from aquaflow.dive.point_cloud import PointCloud, PosedView
from aquaflow.dive.restored import IMAGES, picture_name
from aquaflow.geometry.two_view import INLIER_PX, MIN_MATCHES, RANSAC_CONFIDENCE
from aquaflow.prior.contract import Keypoints
from aquaflow.prior.flow import normalised_grey
from aquaflow.prior.homography import detect
from aquaflow.tracking.loops import match_keypoints

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Picture = npt.NDArray[np.uint8]

OVERLAP_POINTS = 8192
"""Of the map, by which it is told which pictures show the same."""
LEAST_OVERLAP = 0.2
"""Of two pictures that are matched: points in both over points in either."""
KEYPOINTS = 1000
"""Of a picture; two thousand cost four times the time, which is that of comparing descriptors."""
RANKS = (0, 1, 3, 7, 15, 31)
"""Which of the earlier pictures, by overlap, each is matched with: near ones, of which nearly all
keypoints are found again, and ones so far away that the parallax is large."""
MOST_ERROR_PX = 4.0
"""Of a pixel from where the dive has its point; COLMAP's own mapper filters at the same."""
LEAST_ANGLE_RAD = np.radians(1.5)
"""Between the rays to a point; COLMAP triangulates from the same on."""
ROBUST_PX = 1.0
"""Error from which a pixel counts less and less (Cauchy)."""
STEPS = 8
"""Of the reweighted triangulation; after five the points of the reef clip stay where they are."""


@dataclass(frozen=True)
class Tracks:
    """Points with their observations: pixels of posed views."""

    points: Array
    """[T, 3] upright frame."""
    colours: npt.NDArray[np.uint8]
    """[T, 3] RGB, mean of the pixels."""
    errors: Array
    """[T] px: mean distance of the pixels from where the views' poses have the point."""
    track: Index
    """[O] each observation's point, in ascending order."""
    view: Index
    """[O] each observation's view, by its place in the sequence."""
    pixels: Array
    """[O, 2] px, this package's convention."""

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points)

    @property
    def mean_length(self) -> float:
        """Pictures that show a point, on average; 0 where there is none."""
        return len(self.track) / max(len(self), 1)

    @property
    def mean_error_px(self) -> float:
        """Of all points; NaN where there is none."""
        return float(self.errors.mean()) if len(self) else float("nan")

    def in_words(self, why_none: str | None = None) -> str:
        """One sentence; ``why_none``: the reason where there are none, if another than that the
        pictures show too little."""
        if not len(self):
            why = why_none or "the pictures have too few keypoints in common"
            return f"No point has a track: {why}."
        return (
            f"{len(self)} points have a track: in {self.mean_length:.1f} pictures each, "
            f"{self.mean_error_px:.2f} px from where the poses have them."
        )

    def facts(self) -> dict[str, int | float | None]:
        """The same by name."""
        return {
            "tracks": len(self),
            "track_length": self.mean_length if len(self) else None,
            "error_px": self.mean_error_px if len(self) else None,
        }

    @staticmethod
    def none() -> Tracks:
        """No points."""
        empty = np.zeros(0, np.int64)
        return Tracks(
            np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), empty, empty,
            np.zeros((0, 2)),
        )  # fmt: skip


def find_tracks(
    views: Sequence[PosedView],
    cloud: PointCloud,
    picture_of: Callable[[PosedView], Picture],
    progress: Callable[[int, int], None] | None = None,
) -> Tracks:
    """The tracks in the pictures of ``views``; empty where they show too little.

    Args:
        cloud: the map, which tells what pictures have in common.
        picture_of: the picture of a view, [H, W, 3] RGB, or [H, W, 4] where alpha 0 is no scene;
            asked once for each.
        progress: called with (views looked at, views in all).
    """
    partners = _partners(views, cloud)
    last_use = np.arange(len(views))
    for later, earlier_ones in enumerate(partners):
        last_use[earlier_ones] = later
    kept: dict[int, Keypoints] = {}
    pixels: list[npt.NDArray[np.float32]] = []
    colours: list[npt.NDArray[np.uint8]] = []
    links: list[tuple[Index, Index]] = []
    first = np.zeros(len(views) + 1, np.int64)
    for number, view in enumerate(views):
        picture = picture_of(view)
        found = _keypoints(picture)
        column, row = np.floor(found.pixels).astype(int).T
        pixels.append(found.pixels)
        colours.append(picture[row, column, :3])
        first[number + 1] = first[number] + len(found.pixels)
        for earlier in partners[number]:
            a, b = _same_points(kept[earlier], found, views[earlier], view)
            links.append((first[earlier] + a, first[number] + b))
        kept[number] = found
        kept = {each: of for each, of in kept.items() if last_use[each] > number}
        if progress is not None:
            progress(number + 1, len(views))
    if not any(len(found) for found, _ in links):
        return Tracks.none()
    observed = _join(links, first)
    return _placed(observed, np.concatenate(pixels), np.concatenate(colours), views)


def tracks_in_folder(
    out: Path,
    views: Sequence[PosedView],
    cloud: PointCloud,
    progress: Callable[[int, int], None] | None = None,
) -> Tracks:
    """:func:`find_tracks` of the pictures that were written to ``out/images``.

    Raises:
        InputError: one of them cannot be read.
    """

    def picture_of(view: PosedView) -> Picture:
        path = out / IMAGES / picture_name(view.frame_index)
        try:
            return read_png(path)
        except (OSError, ValueError) as error:
            raise InputError(
                f"cannot read {path}, which was just written: {reason_of(error)}; look at the disk"
            ) from error

    return find_tracks(views, cloud, picture_of, progress)


def _partners(views: Sequence[PosedView], cloud: PointCloud) -> list[list[int]]:
    """Of each view, the earlier ones that it is matched with. What hides what is not looked at:
    pictures that do not show the same have no keypoints in common."""
    points = cloud.sample(OVERLAP_POINTS)
    shown = np.array([view.shows(view.T_uc.inverse().apply(points)) for view in views])
    shown = shown.reshape(len(views), len(points)).astype(np.float32)
    count = shown.sum(axis=1)
    partners: list[list[int]] = []
    for number in range(len(views)):
        both = shown[:number] @ shown[number]
        overlap = both / np.maximum(count[:number] + count[number] - both, 1.0)
        nearest_first = np.arange(number)[::-1]
        order = nearest_first[np.argsort(-overlap[::-1], kind="stable")]
        partners.append(
            [int(order[n]) for n in RANKS if n < number and overlap[order[n]] >= LEAST_OVERLAP]
        )
    return partners


def _keypoints(
    picture: Picture,  # [H, W, 3] or [H, W, 4]
) -> Keypoints:
    mask = picture[..., 3] > 0 if picture.shape[2] == 4 else None
    return detect(normalised_grey(np.ascontiguousarray(picture[..., :3]), mask), mask, KEYPOINTS)


def _same_points(
    a: Keypoints, b: Keypoints, view_a: PosedView, view_b: PosedView
) -> tuple[Index, Index]:
    """Indices [M] into a and into b of keypoints that match and that one motion explains, whatever
    the dive has it to be."""
    import cv2

    in_a, in_b = match_keypoints(a, b)
    nothing = np.zeros(0, np.int64)
    if len(in_a) < MIN_MATCHES:
        return nothing, nothing
    # Both as pixels of one camera centred at 0, as in geometry/two_view.py.
    length = view_b.camera.fx
    plane_a, plane_b = (
        length * view.camera.unproject(keypoints.pixels[chosen].astype(np.float64))[:, :2]
        for view, keypoints, chosen in ((view_a, a, in_a), (view_b, b, in_b))
    )
    _, agrees = cv2.findEssentialMat(
        plane_a, plane_b, np.diag([length, length, 1.0]), method=cv2.USAC_MAGSAC,
        prob=RANSAC_CONFIDENCE, threshold=INLIER_PX,
    )  # fmt: skip
    if agrees is None:
        return nothing, nothing
    agreed = agrees[:, 0] > 0
    return in_a[agreed], in_b[agreed]


@dataclass(frozen=True)
class _Observations:
    """Keypoints of points, in the order of the points."""

    track: Index
    """[O] ascending"""
    view: Index
    """[O]"""
    keypoint: Index
    """[O] number among those of all views."""

    def __getitem__(
        self,
        chosen: npt.NDArray[np.bool_],  # [O]
    ) -> _Observations:
        return _Observations(self.track[chosen], self.view[chosen], self.keypoint[chosen])


def _join(
    links: Sequence[tuple[Index, Index]],  # [M] and [M] keypoints of each pair of views
    first: Index,  # [V + 1] number of each view's first keypoint
) -> _Observations:
    """Keypoints that matches connect, over any number of pictures, as one track each."""
    a, b = (np.concatenate(side) for side in zip(*links, strict=True))
    count = int(first[-1])
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(count, count))
    _, of = connected_components(graph, directed=False)
    linked = np.unique(np.concatenate([a, b]))
    view = np.searchsorted(first, linked, side="right") - 1
    order = np.lexsort((view, of[linked]))
    track = np.unique(of[linked[order]], return_inverse=True)[1]
    return _Observations(track, view[order], linked[order])


# --------------------------------------------------------------------------------------------------
# Where the points lie, given the views' poses, and which pixels agree with that.


@dataclass(frozen=True)
class _Rays:
    """Of observations."""

    centres: Array
    """[O, 3] upright frame"""
    directions: Array
    """[O, 3] upright frame, unit length"""
    R_cu: Array
    """[O, 3, 3]"""
    focal: Array
    """[O, 2] px"""
    plane: Array
    """[O, 2] of the ray at z = 1 of the camera."""

    def __getitem__(
        self,
        chosen: npt.NDArray[np.bool_],  # [O]
    ) -> _Rays:
        return _Rays(
            self.centres[chosen], self.directions[chosen], self.R_cu[chosen], self.focal[chosen],
            self.plane[chosen],
        )  # fmt: skip

    def errors_px(
        self,
        points: Array,  # [O, 3] upright frame
    ) -> Array:
        """[O] from the pixel to where the point is seen; infinite behind the camera."""
        seen = np.einsum("oij,oj->oi", self.R_cu, points - self.centres)
        with np.errstate(divide="ignore", invalid="ignore"):
            off = (seen[:, :2] / seen[:, 2:] - self.plane) * self.focal
        return np.where(seen[:, 2] > 0.0, np.hypot(*off.T), np.inf)


def _placed(
    seen: _Observations,
    pixels: npt.NDArray[np.float32],  # [K, 2] of all keypoints
    colours: npt.NDArray[np.uint8],  # [K, 3]
    views: Sequence[PosedView],
) -> Tracks:
    """The tracks that the poses can place, without the observations that do not fit."""
    rays = _rays(seen, pixels, views)
    points = np.zeros((0, 3))
    errors = np.zeros(0)
    for _ in range(2):  # of what is left once what does not fit is gone
        points = _triangulate(seen.track, rays)
        errors = rays.errors_px(points[seen.track])
        fits = (errors <= MOST_ERROR_PX) & _nearest_in_its_view(seen, errors)
        wide = _angles(seen.track, rays, fits) >= LEAST_ANGLE_RAD
        several = np.bincount(seen.track[fits], minlength=len(points)) >= 2
        kept = fits & (wide & several)[seen.track]
        seen, rays, errors = seen[kept], rays[kept], errors[kept]
        known, track = np.unique(seen.track, return_inverse=True)
        seen, points = replace(seen, track=track), points[known]
    if not len(points):
        return Tracks.none()
    length = np.bincount(seen.track)
    mean = [
        np.bincount(seen.track, values) / length
        for values in (*colours[seen.keypoint].T.astype(np.float64), errors)
    ]
    return Tracks(
        points, np.rint(np.column_stack(mean[:3])).astype(np.uint8), mean[3],
        seen.track, seen.view, pixels[seen.keypoint].astype(np.float64),
    )  # fmt: skip


def _rays(
    seen: _Observations,
    pixels: npt.NDArray[np.float32],  # [K, 2]
    views: Sequence[PosedView],
) -> _Rays:
    R_uc = np.array([view.T_uc.R for view in views])[seen.view]
    plane = np.zeros((len(seen.view), 3))
    for number, rows in rows_by(seen.view):
        plane[rows] = views[number].camera.unproject(pixels[seen.keypoint[rows]].astype(np.float64))
    directions = np.einsum("oij,oj->oi", R_uc, plane)
    return _Rays(
        np.array([view.T_uc.t for view in views])[seen.view],
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        R_uc.transpose(0, 2, 1),
        np.array([(view.camera.fx, view.camera.fy) for view in views])[seen.view],
        plane[:, :2],
    )


def rows_by(
    numbers: Index,  # [O]
) -> Iterator[tuple[int, Index]]:
    """Each number that occurs, and the rows where it does."""
    order = np.argsort(numbers, kind="stable")
    found, starts = np.unique(numbers[order], return_index=True)
    yield from zip(found.tolist(), np.split(order, starts)[1:], strict=True)


def _triangulate(
    track: Index,  # [O] ascending
    rays: _Rays,
) -> Array:
    """[T, 3] the points nearest to their rays, in pixels; rays far from the others count little."""
    count = int(track[-1]) + 1 if len(track) else 0
    weights = np.ones(len(track))
    across = np.eye(3) - rays.directions[:, :, None] * rays.directions[:, None, :]
    middle = rays.centres.mean(axis=0) if len(track) else np.zeros(3)
    offset = np.einsum("oij,oj->oi", across, rays.centres - middle)
    points = np.zeros((count, 3))
    for _ in range(STEPS):
        A = np.zeros((count, 3, 3))
        b = np.zeros((count, 3))
        np.add.at(A, track, weights[:, None, None] * across)
        np.add.at(b, track, weights[:, None] * offset)
        # Of parallel rays, which have no nearest point, one that is far away.
        A += 1e-9 * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        points = np.linalg.solve(A, b[..., None])[..., 0] + middle
        range_ = np.linalg.norm(points[track] - rays.centres, axis=1)
        errors = np.minimum(rays.errors_px(points[track]), 1e6)
        weights = 1.0 / (1.0 + (errors / ROBUST_PX) ** 2)
        weights *= (rays.focal[:, 0] / np.maximum(range_, 1e-9)) ** 2
    return points


def _nearest_in_its_view(
    seen: _Observations,
    errors: Array,  # [O] px
) -> npt.NDArray[np.bool_]:
    """[O] False for all but one of the keypoints that a picture has of one track."""
    order = np.lexsort((errors, seen.view, seen.track))
    track, view = seen.track[order], seen.view[order]
    repeated = np.zeros(len(order), bool)
    repeated[1:] = (track[1:] == track[:-1]) & (view[1:] == view[:-1])
    nearest = np.ones(len(order), bool)
    nearest[order[repeated]] = False
    return nearest


def _angles(
    track: Index,  # [O]
    rays: _Rays,
    counted: npt.NDArray[np.bool_],  # [O]
) -> Array:
    """[T] radians: twice the largest angle between a ray to the point and their mean."""
    count = int(track[-1]) + 1 if len(track) else 0
    mean = np.zeros((count, 3))
    np.add.at(mean, track[counted], rays.directions[counted])
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    off = np.linalg.norm(np.cross(rays.directions[counted], mean[track[counted]]), axis=1)
    largest = np.zeros(count)
    np.maximum.at(largest, track[counted], off)
    return np.asarray(2.0 * np.arcsin(np.clip(largest, 0.0, 1.0)))
