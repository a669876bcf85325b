"""Boards to calibrate with: ChArUco and grids of AprilTags, found in pictures and printed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import ConfigError, InputError, reason_of

Array = npt.NDArray[np.float64]
BoardKind = Literal["charuco", "apriltag"]

DICTIONARIES = {"charuco": "5X5_250", "apriltag": "APRILTAG_36h11"}
"""Of OpenCV; the codes that a board's markers are drawn with."""
MARKER_SHARE = {"charuco": 0.75, "apriltag": 0.8}
"""Side of a marker over that of its square: white around it lets the detector find it."""
LEAST_SIDE = 3
"""Squares along a side."""
WINDOW_CELLS = 0.8
"""Half the window in which a tag's corner is refined, over a cell of its code: of rendered tags
0.18 px are left; with OpenCV's 0.3 it is 0.42, and with 1.2, which holds other cells, 0.40."""
LARGEST_WINDOW_PX = 8
"""The same for tags that fill the picture."""
TAG_CORNERS = 4


@dataclass(frozen=True)
class Board:
    """A flat board of ``columns`` x ``rows`` squares."""

    kind: BoardKind
    columns: int
    rows: int
    square_m: float
    """Measured from edge to edge: of a ChArUco's square, or from tag to tag."""

    @property
    def marker_m(self) -> float:
        """Side of the black square of a marker."""
        return self.square_m * MARKER_SHARE[self.kind]


@dataclass(frozen=True)
class Found:
    """The corners of a board in one picture."""

    numbers: npt.NDArray[np.int64]
    """[N] of the corners on the board."""
    points_m: Array
    """[N, 3] on the board, z = 0."""
    pixels: Array
    """[N, 2] in the picture, the centre of the first pixel at (0.5, 0.5)."""


class Detector:
    """Finds one board."""

    def __init__(self, board: Board) -> None:
        """Prepare for ``board``.

        Raises:
            ConfigError: it has too few squares, or more markers than there are codes.
        """
        self._made = made = opencv_board(board)
        settings = cv2.aruco.DetectorParameters()
        self._charuco_detector = None
        if isinstance(made, cv2.aruco.CharucoBoard):
            self._squares = np.asarray(made.getChessboardCorners(), np.float64)
            # The markers' own corners, refined, move the squares' by 0.1 px in tilted views.
            settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
            parameters = cv2.aruco.CharucoParameters()
            self._charuco_detector = cv2.aruco.CharucoDetector(made, parameters, settings)
        else:
            settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
            settings.cornerRefinementWinSize = LARGEST_WINDOW_PX
            settings.relativeCornerRefinmentWinSize = WINDOW_CELLS
            settings.cornerRefinementMaxIterations = 60
            settings.cornerRefinementMinAccuracy = 1e-3
        self._detector = cv2.aruco.ArucoDetector(made.getDictionary(), settings)

    def __call__(
        self,
        grey: npt.NDArray[np.uint8],  # [H, W]
    ) -> Found:
        """The corners that the picture shows; none if there is no board."""
        if self._charuco_detector is not None:
            corners, ids, _, _ = self._charuco_detector.detectBoard(grey)
            if ids is None or len(ids) == 0:
                return _nothing()
            numbers = np.ravel(ids).astype(np.int64)
            points = self._squares[numbers]
            return Found(numbers, points, np.asarray(corners, np.float64).reshape(-1, 2) + 0.5)
        quads, ids, _ = self._detector.detectMarkers(grey)
        if ids is None or len(ids) == 0:
            return _nothing()
        markers, known = np.ravel(ids).astype(np.int64), np.asarray(self._made.getObjPoints())
        pixels = np.asarray(quads, np.float64).reshape(-1, TAG_CORNERS, 2) + 0.5
        on_board = markers < len(known)
        markers, pixels = markers[on_board], pixels[on_board]
        numbers = TAG_CORNERS * markers[:, None] + np.arange(TAG_CORNERS)
        points = known[markers].astype(np.float64).reshape(-1, 3)
        return Found(numbers.ravel(), points, pixels.reshape(-1, 2))


def _nothing() -> Found:
    return Found(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)))


def opencv_board(board: Board) -> cv2.aruco.CharucoBoard | cv2.aruco.GridBoard:
    """OpenCV's board, in metres.

    Raises:
        ConfigError: it has too few squares, or more markers than there are codes.
    """
    if min(board.columns, board.rows) < LEAST_SIDE:
        raise ConfigError(
            f"a board of {board.columns} x {board.rows} squares is too small to calibrate with; "
            f"use {LEAST_SIDE} x {LEAST_SIDE} at least"
        )
    name = DICTIONARIES[board.kind]
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
    size, codes = (board.columns, board.rows), len(dictionary.bytesList)
    markers = board.columns * board.rows // (2 if board.kind == "charuco" else 1)
    if markers > codes:
        raise ConfigError(
            f"a {board.kind} board of {board.columns} x {board.rows} squares needs {markers} "
            f"markers, {name} has {codes}; use fewer squares"
        )
    if board.kind == "charuco":
        return cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary)
    gap = board.square_m - board.marker_m
    return cv2.aruco.GridBoard(size, board.marker_m, gap, dictionary)


def draw(board: Board, pixels_per_square: int) -> npt.NDArray[np.uint8]:
    """[H, W] the board with a white edge of half a square; ``pixels_per_square`` is a multiple of
    10, so that every cell of a tag is made of whole pixels."""
    made, margin = opencv_board(board), pixels_per_square // 2
    size = ((board.columns + 1) * pixels_per_square, (board.rows + 1) * pixels_per_square)
    if board.kind == "charuco":
        return np.asarray(made.generateImage(size, marginSize=margin), np.uint8)
    image = np.full(size[::-1], 255, np.uint8)  # OpenCV's own picture of a grid is stretched
    side = round(pixels_per_square * MARKER_SHARE[board.kind])
    for number, corners in enumerate(np.asarray(made.getObjPoints())):
        x, y = np.rint(corners[0, :2] / board.square_m * pixels_per_square).astype(int) + margin
        tag = cv2.aruco.generateImageMarker(made.getDictionary(), number, side)
        image[y : y + side, x : x + side] = tag
    return image


DOTS_PER_INCH = 600
"""Of a printed board, about; what is written is exact to the size of the squares."""
INCH_M = 0.0254


def write_board(board: Board, path: Path) -> None:
    """Write the board to print at its true size, as PDF or PNG.

    Raises:
        ConfigError: the board cannot be, or the file's name ends in neither .pdf nor .png.
        InputError: the file cannot be written.
    """
    from PIL import Image

    if path.suffix.lower() not in {".pdf", ".png"}:
        raise ConfigError(f"{path} is neither a .pdf nor a .png; choose one of them")
    tens = max(1, round(board.square_m / INCH_M * DOTS_PER_INCH / 10.0))
    image = Image.fromarray(draw(board, 10 * tens))
    exact = 10 * tens * INCH_M / board.square_m
    try:
        if path.suffix.lower() == ".pdf":
            image.save(path, resolution=exact)
        else:
            image.save(path, dpi=(exact, exact))
    except OSError as error:
        raise InputError(f"cannot write {path}: {reason_of(error)}") from error
