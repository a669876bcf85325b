"""Boards to calibrate with: ChArUco and AprilTags, printed, found, and which views count."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import ArgumentError, InputError, reason_of

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
            ArgumentError: it has too few squares, or more markers than there are codes.
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
        ArgumentError: it has too few squares, or more markers than there are codes.
    """
    if min(board.columns, board.rows) < LEAST_SIDE:
        raise ArgumentError(
            f"a board of {board.columns} x {board.rows} squares is too small to calibrate with; "
            f"use {LEAST_SIDE} x {LEAST_SIDE} at least"
        )
    name = DICTIONARIES[board.kind]
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
    size, codes = (board.columns, board.rows), len(dictionary.bytesList)
    markers = board.columns * board.rows // (2 if board.kind == "charuco" else 1)
    if markers > codes:
        raise ArgumentError(
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
        ArgumentError: the board cannot be, or the file's name ends in neither .pdf nor .png.
        InputError: the file cannot be written.
    """
    from PIL import Image

    if path.suffix.lower() not in {".pdf", ".png"}:
        raise ArgumentError(f"{path} is neither a .pdf nor a .png; choose one of them")
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


# --------------------------------------------------------------------------------------------------
# The pictures that a calibration is made from: those that show the board, each unlike the rest.

LEAST_CORNERS = 8
"""Of a picture; six of its numbers are the board's pose."""
LEAST_VIEWS = 8
"""Pictures that differ: fewer leave the focal length to chance, whatever its formal sigma."""
MOST_VIEWS = 60
"""More cost time and teach nothing; a video shows the board in a thousand."""
LEAST_MOVE = 0.02
"""Of the picture's width, in the mean over the corners: pictures closer than this are alike."""
COVERAGE_CELLS = 8
"""Cells along each side of the picture, of which a share is covered by corners."""


@dataclass(frozen=True)
class BoardImage:
    """One picture with the board in it."""

    name: str
    found: Found


@dataclass(frozen=True)
class Views:
    """The pictures of one size that a calibration uses, and what was left out."""

    width: int
    height: int
    used: list[BoardImage]
    read: int
    """Pictures in all."""
    without_board: list[str]
    alike: list[str]

    @property
    def coverage(self) -> float:
        """Share of the picture, in cells, in which corners were seen."""
        cells = np.concatenate([view.found.pixels for view in self.used])
        cells = cells / (self.width, self.height) * COVERAGE_CELLS
        inside = np.clip(cells, 0, COVERAGE_CELLS - 1).astype(int)
        return len(np.unique(inside, axis=0)) / COVERAGE_CELLS**2


def find_views(
    pictures: Iterable[tuple[str, npt.NDArray[np.uint8]]],  # [H, W, 3] RGB
    detector: Detector,
) -> Views:
    """Look for the board in every picture.

    Raises:
        InputError: the pictures are of several sizes, too few show the board, or too few of those
            differ.
    """
    used: list[BoardImage] = []
    without, alike, size, read = [], [], (0, 0), 0
    for name, image in pictures:
        height, width = image.shape[:2]
        if size not in ((0, 0), (width, height)):
            raise InputError(
                f"{name} is {width} x {height}, those before it {size[0]} x {size[1]}; give "
                "pictures of one size"
            )
        size, read = (width, height), read + 1
        found = detector(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8))
        if not _determines_a_pose(found):
            without.append(name)
        elif any(_alike(found, other.found, LEAST_MOVE * width) for other in used):
            alike.append(name)
        else:
            used.append(BoardImage(name, found))
    views = Views(*size, _spread(used), read, without, alike)
    _refuse_too_few(views)
    return views


def _refuse_too_few(views: Views) -> None:
    shown = views.read - len(views.without_board)
    if shown < LEAST_VIEWS:
        raise InputError(
            f"{shown} of {views.read} pictures show the board, {LEAST_VIEWS} are needed; check "
            "--board, --columns, --rows and --square-mm, and that the board is sharp and whole"
        )
    if len(views.used) < LEAST_VIEWS:
        raise InputError(
            f"only {len(views.used)} of {shown} pictures of the board differ, {LEAST_VIEWS} are "
            "needed; move the board to every part of the picture and tilt it by 30 degrees"
        )


def _determines_a_pose(found: Found) -> bool:
    if len(found.numbers) < LEAST_CORNERS:
        return False
    flat = found.points_m[:, :2] - found.points_m[:, :2].mean(axis=0)
    spread = np.linalg.svd(flat, compute_uv=False)
    return bool(spread[1] > 0.1 * spread[0])  # in one row they leave the pose open


def _alike(one: Found, other: Found, least_px: float) -> bool:
    _, mine, theirs = np.intersect1d(one.numbers, other.numbers, return_indices=True)
    if len(mine) < LEAST_CORNERS:
        return False
    moved = np.linalg.norm(one.pixels[mine] - other.pixels[theirs], axis=1)
    return bool(moved.mean() < least_px)


def _spread(views: list[BoardImage]) -> list[BoardImage]:
    """At most MOST_VIEWS of them, evenly over the order in which they were taken."""
    if len(views) <= MOST_VIEWS:
        return views
    return [views[k] for k in np.linspace(0, len(views) - 1, MOST_VIEWS).astype(int)]
