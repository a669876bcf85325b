"""Markers and ChArUco boards in a picture, by OpenCV's detector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.config.telemetry import BoardConfig, CharucoConfig, MarkersConfig

Array = npt.NDArray[np.float64]

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
        """For the report."""
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
