"""Pictures of a board as a camera takes them, with its lens, its port and its noise."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from aquaflow.calibration.board import Board, draw
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.optics import rays_of_pixels

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

SQUARE_PX = 60
RAYS = 2
"""Along each side of a pixel."""
KNOT_PX = 8


def poses(count: int, range_m: float, board: Board, seed: int = 0) -> list[tuple[Array, Array]]:
    """R [3, 3] and t [3] of the board's first corner: tilted by up to 40 degrees, moved about."""
    rng = np.random.default_rng(seed)
    middle = 0.5 * board.square_m * np.array([board.columns, board.rows, 0.0])
    made = []
    for k in range(count):
        turn = Rotation.from_euler("xyz", [*rng.uniform(-40, 40, 2), rng.uniform(-20, 20)], True)
        aside = 0.25 * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.0]) * rng.uniform(0.0, 1.0)
        aside[2] = 1.0
        place = range_m * rng.uniform(0.8, 1.3) * aside
        made.append((turn.as_matrix(), place - turn.apply(middle)))
    return made


def taken(
    camera: CameraModel, board: Board, R: Array, t: Array, noise: float = 2.0, seed: int = 0
) -> Image:
    """[H, W, 3] the board in front of grey water."""
    print_ = draw(board, SQUARE_PX).astype(np.float32)
    # Where rays meet the board is smooth: it is computed at every few pixels.
    u, v = (np.linspace(0.0, side, side // KNOT_PX + 1) for side in (camera.width, camera.height))
    origins, rays = rays_of_pixels(camera, np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    # In the board's own axes its plane is z = 0.
    start, ray = (origins - t) @ R, rays @ R
    meets = start - ray * (start[:, 2:] / ray[:, 2:])
    place = meets[:, :2] / board.square_m * SQUARE_PX + SQUARE_PX // 2 - 0.5
    columns, rows = (
        (np.arange(side * RAYS) + 0.5) / RAYS for side in (camera.width, camera.height)
    )
    x, y = (
        RectBivariateSpline(v, u, place[:, k].reshape(len(v), len(u)))(rows, columns)
        for k in (0, 1)
    )
    seen = cv2.remap(
        print_, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderValue=120.0
    )
    small = cv2.resize(seen, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    rng = np.random.default_rng(seed)
    small = 20.0 + 0.8 * small + noise * rng.standard_normal(small.shape)
    return np.repeat(np.clip(np.rint(small), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def pictures(
    camera: CameraModel, board: Board, count: int, range_m: float, seed: int = 0
) -> list[tuple[str, Image]]:
    """Named pictures of the board in different poses."""
    made = enumerate(poses(count, range_m, board, seed))
    return [(f"{k:03d}.png", taken(camera, board, R, t, seed=seed + k)) for k, (R, t) in made]
