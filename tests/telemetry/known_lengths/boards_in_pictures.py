"""Pictures of printed boards, seen from known places, in a map whose unit is 2.05 m."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from aquaflow.config.telemetry import BoardConfig, CharucoConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.telemetry.known_lengths.board_size import BoardView, charuco_board

CAMERA = CameraModel(640, 480, 520.0, 520.0, 318.0, 243.0)
METRES_PER_UNIT = 2.05
T_NM = Sim3(so3_exp(np.array([0.4, -1.1, 0.7])), np.array([3.0, -2.0, 1.5]), METRES_PER_UNIT)
FINER = 3
"""Pictures are drawn this much larger, then averaged."""
PRINT_PX = 40
"""Of a bit of a marker in its drawing."""


@dataclass(frozen=True)
class Printed:
    """A board as it is printed: its picture, and what one of its pixels measures."""

    config: BoardConfig
    marker: int = 7
    drawing: np.ndarray = field(init=False)
    pixel_m: float = field(init=False)
    origin: tuple[float, float] = field(init=False)
    """Of the drawing's top left corner in the board, metres."""

    def __post_init__(self) -> None:
        if isinstance(self.config, CharucoConfig):
            c, px = self.config, 120
            size = (c.columns * px, c.rows * px)
            inner = charuco_board(c).generateImage(size, marginSize=0, borderBits=1)
            pixel_m, corner = c.square_m / px, (0.0, 0.0)
        else:
            name = f"DICT_{self.config.dictionary}"
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
            bits = dictionary.markerSize + 2
            inner = cv2.aruco.generateImageMarker(dictionary, self.marker, bits * PRINT_PX)
            pixel_m = self.config.marker_m / (bits * PRINT_PX)
            corner = (-0.5 * self.config.marker_m, -0.5 * self.config.marker_m)
        margin = 2 * PRINT_PX
        drawing = np.pad(inner, margin, constant_values=255)
        object.__setattr__(self, "drawing", drawing)
        object.__setattr__(self, "pixel_m", pixel_m)
        object.__setattr__(
            self, "origin", (corner[0] - margin * pixel_m, corner[1] - margin * pixel_m)
        )

    def corners(self) -> np.ndarray:
        """[4, 3] of the drawing on the board, x right, y down, metres."""
        h, w = self.drawing.shape
        x, y = self.origin
        far = (x + w * self.pixel_m, y + h * self.pixel_m)
        return np.array([[x, y, 0], [far[0], y, 0], [*far, 0], [x, far[1], 0]])


def looking(at: np.ndarray, place: np.ndarray, roll: float = 0.0) -> Sim3:
    """A camera, to metres, at ``place`` that looks at ``at``."""
    z = (at - place) / np.linalg.norm(at - place)
    x = np.cross(np.array([0.0, 1.0, 0.0]), z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    return Sim3(R @ so3_exp(np.array([0.0, 0.0, roll])), place)


def around(count: int, distance_m: float = 0.9, swing_m: float = 0.35) -> list[Sim3]:
    """Cameras on an arc in front of a board at the origin that faces them."""
    angles = np.linspace(-1.0, 1.0, count)
    places = [np.array([swing_m * a, 0.15 * a * a - 0.1, -distance_m]) for a in angles]
    return [looking(np.zeros(3), place, 0.1 * k) for k, place in enumerate(places)]


def photographed(boards: list[tuple[Printed, Sim3]], T_nc: Sim3, seed: int = 0) -> np.ndarray:
    """[H, W, 3] the boards, each at its pose to metres, before a mottled sea floor."""
    rng = np.random.default_rng(seed)
    w, h = CAMERA.width * FINER, CAMERA.height * FINER
    floor = cv2.resize(rng.uniform(60, 150, (60, 80)).astype(np.float32), (w, h))
    camera = CAMERA.resize(w, h)
    for board, T_nb in boards:
        seen = camera.project(T_nc.inverse().apply(T_nb.apply(board.corners())))
        size = board.drawing.shape
        flat = np.array([[0, 0], [size[1], 0], [size[1], size[0]], [0, size[0]]])
        # Pixel centres at half: OpenCV's at whole numbers.
        M = cv2.getPerspectiveTransform(
            (flat - 0.5).astype(np.float32), (seen - 0.5).astype(np.float32)
        )
        tone = (30.0 + 0.7 * board.drawing).astype(np.float32)
        floor = cv2.warpPerspective(
            tone, M, (w, h), floor, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT
        )
    small = cv2.resize(floor, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    noisy = cv2.GaussianBlur(small, (0, 0), 0.6) + rng.normal(0.0, 3.0, small.shape)
    return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def in_map(T_nc: Sim3, rho: np.ndarray | None = None, sub_map: int = 0) -> BoardView:
    """The view as the map has it; ``rho`` [H, W] of 1 % depths."""
    T = T_NM.inverse() @ T_nc
    T_wc = Sim3(T.R, T.t)
    variance = None if rho is None else (0.01 * rho) ** 2
    return BoardView(CAMERA, T_wc, sub_map, rho, variance)
