"""How large a board is in the map: one similarity from the board to the map, by least squares.

The unknowns are the board's pose and scale in the map and, with a prior, a small error of each
view's pose. What is measured are its corners in every view and, where a view's depth is known, the
inverse depth there. From one view without depth the scale does not follow: a board of twice the
size at twice the range looks the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from aquaflow.config.telemetry import BoardConfig, CharucoConfig, MarkersConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp, so3_log
from aquaflow.telemetry.known_lengths.known_length import KnownLength

Array = npt.NDArray[np.float64]

CORNER_SIGMA_PX = 0.3
"""1 sigma of a refined corner: 0.05 to 0.2 px on rendered boards, more in turbid water."""
POSE_SIGMA_PX = 0.5
"""1 sigma of a view's pose, as what it moves a point in the picture (residuals of tracking)."""
LARGEST_MISFIT = 4.0
"""Chi-square per degree of freedom; beyond, the board moved, or it is not the one that it seems."""
LARGEST_SIGMA = 0.2
"""Relative, of the size; beyond, there is too little parallax to speak of a measurement."""
MOST_VIEWS = 8
"""Views of one board, spread over all: each further one adds little and costs its six unknowns."""
LEAST_DEPTH = 1e-6
"""Points are kept in front of the camera while the fit looks for its minimum."""


@dataclass(frozen=True)
class PixelDepths:
    """Inverse depth of some pixels of a picture."""

    pixels: Array
    """[N, 2]"""
    rho: Array
    """[N] inverse depth, 0 where unknown."""
    variance: Array
    """[N]; infinite where unknown."""

    def at(
        self,
        pixels: Array,  # [M, 2]
    ) -> tuple[Array, Array]:
        """Inverse depths [M] and their variances [M]; unknown for any pixel that was not kept."""
        kept = {(u, v): row for row, (u, v) in enumerate(self.pixels.tolist())}
        rows = np.array([kept.get((u, v), -1) for u, v in pixels.tolist()], int)
        rho = np.append(self.rho, 0.0)[rows]
        return rho, np.append(self.variance, np.inf)[rows]


@dataclass(frozen=True)
class BoardView:
    """A picture's place in a sub-map, and its depth at a board's corners where it is known."""

    camera: CameraModel
    T_wc: Sim3
    sub_map: int
    rho: Array | None = None
    """[H, W] inverse depth, 0 where unknown."""
    variance: Array | None = None
    """[H, W]"""
    depths: PixelDepths | None = None
    """In place of both, where only the depths that will be asked for were kept."""

    def depth_at(
        self,
        pixels: Array,  # [N, 2]
    ) -> tuple[Array, Array]:
        """Inverse depths [N] and their variances [N]; infinite where nothing is known."""
        if self.depths is not None:
            return self.depths.at(pixels)
        if self.rho is None or self.variance is None:
            return np.zeros(len(pixels)), np.full(len(pixels), np.inf)
        columns = np.clip(pixels[:, 0].astype(int), 0, self.rho.shape[1] - 1)
        rows = np.clip(pixels[:, 1].astype(int), 0, self.rho.shape[0] - 1)
        rho, variance = self.rho[rows, columns], self.variance[rows, columns]
        return rho, np.where(rho > 0.0, variance, np.inf)


def board_lengths(
    sightings: Iterable[BoardSighting], view_of: Callable[[int], BoardView | None]
) -> list[KnownLength]:
    """One length for each board in each sub-map; boards that cannot be measured give none.

    ``view_of`` gives a frame's place by its index; None for a frame without a pose.
    """
    groups: dict[tuple[int, int | None, int], list[tuple[BoardSighting, BoardView]]] = {}
    for sighting in sightings:
        view = view_of(sighting.frame_index)
        if view is not None:
            key = (sighting.board, sighting.marker, view.sub_map)
            groups.setdefault(key, []).append((sighting, view))
    lengths = (_length(group, sub_map) for (_, _, sub_map), group in groups.items())
    return [length for length in lengths if length is not None]


def _length(group: Sequence[tuple[BoardSighting, BoardView]], sub_map: int) -> KnownLength | None:
    step = max(1.0, (len(group) - 1) / (MOST_VIEWS - 1))
    chosen = [group[round(k * step)] for k in range(min(len(group), MOST_VIEWS))]
    fitted = _fit([_Seen(*each) for each in chosen])
    if fitted is None:
        return None
    units_per_metre, sigma = fitted
    nearest = max((sighting for sighting, _ in chosen), key=_extent)
    map_length = units_per_metre * nearest.length_m
    return KnownLength(
        nearest.frame_index, nearest.name, map_length, sigma * map_length,
        nearest.length_m, nearest.sigma_m, sub_map,
    )  # fmt: skip


def _extent(sighting: BoardSighting) -> float:
    """In pixels."""
    return float(np.linalg.norm(np.ptp(sighting.pixels, axis=0)))


class _Seen:
    """One view of the board, with what of it does not change during the fit."""

    def __init__(self, sighting: BoardSighting, view: BoardView) -> None:
        self.camera, self.T_wc, self.T_cw = view.camera, view.T_wc, view.T_wc.inverse()
        self.points, self.pixels = sighting.points_m, sighting.pixels
        self.rho, variance = view.depth_at(self.pixels)
        # A depth map errs alike over a board: all its corners together count as one measurement.
        self.rho_sigma = np.sqrt(variance * len(self.rho))
        self.has_depth = bool(np.isfinite(self.rho_sigma).all())

    def poses(self) -> list[Sim3]:
        """Camera from board, metres: two where a plane may lean to or fro."""
        K = self.camera.K.copy()
        K[:2, 2] -= 0.5  # OpenCV's pixel centres
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            self.points, self.pixels - 0.5, K, None, flags=cv2.SOLVEPNP_IPPE
        )
        poses = [
            Sim3(so3_exp(np.ravel(turn).astype(np.float64)), np.ravel(shift).astype(np.float64))
            for turn, shift in zip(turns, shifts, strict=True)
        ]
        return [pose for pose in poses if pose.is_finite()]


def _fit(seen: Sequence[_Seen]) -> tuple[float, float] | None:
    """Map units per metre and the relative sigma; None where it does not follow or fit."""
    if len(seen) < 2 and not seen[0].has_depth:
        return None
    tried = [
        least_squares(_residuals, start, args=(seen,), method="lm", x_scale="jac")
        for start in _starts(seen)
    ]
    if not tried:
        return None
    best = min(tried, key=lambda found: float(found.cost))
    cost, x, jac = float(best.cost), np.asarray(best.x), np.asarray(best.jac)
    freedom = len(jac) - len(x)
    information = jac.T @ jac
    if freedom < 1 or not np.isfinite(information).all():
        return None
    misfit = 2.0 * cost / freedom
    variance = float(np.linalg.pinv(information, hermitian=True)[6, 6]) * max(1.0, misfit)
    sigma = float(np.sqrt(variance))
    if misfit > LARGEST_MISFIT or not 0.0 < sigma <= LARGEST_SIGMA:
        return None
    return float(np.exp(x[6])), sigma


def _starts(seen: Sequence[_Seen]) -> list[Array]:
    """A start for each way the board may lean in the view that shows it largest."""
    largest = max(seen, key=lambda each: float(np.ptp(each.pixels, axis=0).max()))
    starts: list[Array] = []
    for pose in largest.poses():
        scale = _first_scale(seen, largest, pose)
        if scale is None:
            continue
        T_wb = largest.T_wc @ Sim3(pose.R, scale * pose.t / largest.T_wc.scale)
        start = np.zeros(7 + 6 * len(seen))
        start[:3], start[3:6], start[6] = T_wb.t, so3_log(T_wb.R), np.log(scale)
        starts.append(start)
    return starts


def _first_scale(seen: Sequence[_Seen], largest: _Seen, pose: Sim3) -> float | None:
    """Map units per metre: by depth where it is known, else from where the views meet."""
    if largest.has_depth:
        z_m = pose.apply(largest.points)[:, 2]
        return largest.T_wc.scale * float(np.median(1.0 / largest.rho / z_m))
    # R_i (s t_i) + c_i = p in every view: linear in the scale s and the board's place p.
    rows, right = [], []
    for view in seen:
        poses = [pose] if view is largest else view.poses()
        if poses:
            rows.append(np.hstack([(view.T_wc.R @ poses[0].t)[:, None], -np.eye(3)]))
            right.append(-view.T_wc.t)
    if len(rows) < 2:
        return None
    scale = float(np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0][0])
    return scale if np.isfinite(scale) and scale > 0.0 else None


def _residuals(
    x: Array,  # [7 + 6 V] board in the map, then each view's error
    seen: Sequence[_Seen],
) -> Array:
    """[R] in sigmas: corners, depths, errors of the views' poses."""
    R_wb, scale = so3_exp(x[3:6]), float(np.exp(np.clip(x[6], -50.0, 50.0)))
    parts = []
    for number, view in enumerate(seen):
        error = x[7 + 6 * number : 13 + 6 * number]
        world = scale * view.points @ R_wb.T + x[:3]
        local = view.T_cw.apply(world)
        depth = max(float(np.median(local[:, 2])), LEAST_DEPTH)
        # The error is in sigmas of POSE_SIGMA_PX: a turn, and a shift at the board's range.
        unit = POSE_SIGMA_PX / view.camera.fx
        local = local @ so3_exp(unit * error[3:]).T + unit * depth * error[:3]
        local[:, 2] = np.maximum(local[:, 2], LEAST_DEPTH)
        parts.append(np.ravel(view.camera.project(local) - view.pixels) / CORNER_SIGMA_PX)
        if view.has_depth:
            parts.append((1.0 / local[:, 2] - view.rho) / view.rho_sigma)
        parts.append(error)
    return np.concatenate(parts)


# --------------------------------------------------------------------------------------------------
# Markers and ChArUco boards in a picture, by OpenCV's detector.

LEAST_SIDE_PX = 16.0
"""Of a marker: smaller ones have two pixels a bit, and anything may look like one."""
LEAST_CORNERS = 6
"""Of a ChArUco board, so that its pose is determined with a few to spare."""
CORRECTION_RATE = 0.3
"""Share of a code's correctable bits that may be wrong, half of OpenCV's default: a marker that is
read wrongly has another size."""
WINDOW_PX = 5
"""Half the window of sub-pixel refinement; OpenCV's default."""


@dataclass(frozen=True)
class BoardSighting:
    """One rigid object of known size in one picture."""

    frame_index: int
    board: int
    """Position in ``fusion.boards``."""
    marker: int | None
    """Number of the marker; None for a whole board."""
    points_m: Array
    """[N, 3] of its corners, z = 0, metres."""
    pixels: Array
    """[N, 2] where they are seen."""
    length_m: float
    sigma_m: float
    """The length that was measured by hand, and its 1 sigma."""

    @property
    def name(self) -> str:
        """Name for the report."""
        return f"board {self.board}" if self.marker is None else f"marker {self.marker}"


Look: TypeAlias = Callable[[int, npt.NDArray[np.uint8]], list[BoardSighting]]
"""The sightings of one board in the grey picture [H, W] of a frame."""


class BoardDetector:
    """Looks for every configured board; costs some milliseconds a picture."""

    def __init__(self, boards: Sequence[BoardConfig]) -> None:
        self._looks = [_look(number, board) for number, board in enumerate(boards)]

    def __call__(
        self,
        frame_index: int,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    ) -> list[BoardSighting]:
        """The boards that the picture shows."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        return [sighting for look in self._looks for sighting in look(frame_index, grey)]


def _look(number: int, board: BoardConfig) -> Look:
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.cornerRefinementWinSize = WINDOW_PX
    settings.errorCorrectionRate = CORRECTION_RATE
    if isinstance(board, MarkersConfig):
        detector = cv2.aruco.ArucoDetector(_dictionary(board.dictionary), settings)
        return partial(_markers, number, board, detector)
    made = charuco_board(board)
    finder = cv2.aruco.CharucoDetector(made, cv2.aruco.CharucoParameters(), settings)
    return partial(_charuco, number, board, finder)


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def charuco_board(board: CharucoConfig) -> cv2.aruco.CharucoBoard:
    """OpenCV's board, in metres."""
    size, dictionary = (board.columns, board.rows), _dictionary(board.dictionary)
    made = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary)
    made.setLegacyPattern(board.legacy)
    return made


def marker_corners(side_m: float) -> Array:
    """[4, 3] in OpenCV's order: top left, top right, bottom right, bottom left, y up."""
    half = 0.5 * side_m
    return half * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def _markers(
    number: int,
    board: MarkersConfig,
    detector: cv2.aruco.ArucoDetector,
    frame_index: int,
    grey: npt.NDArray[np.uint8],  # [H, W]
) -> list[BoardSighting]:
    quads, ids, _ = detector.detectMarkers(grey)
    numbers = [] if ids is None else [int(each) for each in np.ravel(ids)]
    seen = []
    for marker, quad in zip(numbers, quads, strict=True):
        pixels = np.asarray(quad, np.float64).reshape(4, 2) + 0.5
        sides = np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1)
        # With two of one number, it is open which of them another picture shows.
        if numbers.count(marker) > 1 or float(sides.min()) < LEAST_SIDE_PX:
            continue
        if not board.ids or marker in board.ids:
            points = marker_corners(board.marker_m)
            lengths = (board.marker_m, board.sigma_m)
            seen.append(BoardSighting(frame_index, number, marker, points, pixels, *lengths))
    return seen


def _charuco(
    number: int,
    board: CharucoConfig,
    detector: cv2.aruco.CharucoDetector,
    frame_index: int,
    grey: npt.NDArray[np.uint8],  # [H, W]
) -> list[BoardSighting]:
    corners, ids, _, _ = detector.detectBoard(grey)
    if ids is None or len(ids) < LEAST_CORNERS:
        return []
    points = np.asarray(charuco_board(board).getChessboardCorners(), np.float64)[np.ravel(ids)]
    spread = np.linalg.svd(points[:, :2] - points[:, :2].mean(0), compute_uv=False)
    if spread[1] < 0.5 * board.square_m:  # in one row: no plane
        return []
    pixels = np.asarray(corners, np.float64).reshape(-1, 2) + 0.5
    lengths = (board.square_m, board.sigma_m)
    return [BoardSighting(frame_index, number, None, points, pixels, *lengths)]
