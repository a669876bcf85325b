"""Pictures of a sloping sea floor with two laser dots, in a map whose unit is 2.05 m."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from aquaflow.config.telemetry import LasersConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.known_lengths.board_size import BoardView
from aquaflow.telemetry.known_lengths.finder import find_dots, laser_lengths
from aquaflow.telemetry.known_lengths.known_length import KnownLength

CAMERA = CameraModel(640, 480, 520.0, 520.0, 318.0, 243.0)
METRES_PER_UNIT = 2.05
LASERS = LasersConfig(colour="green", spacing_m=0.1)
BEAMS = np.array([[-0.05, 0.04], [0.05, 0.04]])
"""Of the beams from the optical axis, metres right and down."""
Colour = Literal["red", "green", "blue"]
CHANNEL = {"red": 0, "green": 1, "blue": 2}


def dotted(
    pixels: np.ndarray, colour: Colour = "green", seed: int = 0, radius: float = 3.0
) -> np.ndarray:
    """[H, W, 3] a mottled sea floor with laser dots whose core saturates every channel."""
    rng = np.random.default_rng(seed)
    floor = cv2.resize(rng.uniform(40, 120, (40, 50)).astype(np.float32), (640, 480))
    image = np.repeat(floor[..., None], 3, axis=2) * np.array([0.6, 1.0, 0.9])
    v, u = np.indices((480, 640)) + 0.5
    for x, y in pixels:
        light = np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * radius**2))
        glow = np.full(3, 120.0)
        glow[CHANNEL[colour]] = 600.0
        image = image + light[..., None] * glow
    return np.clip(image + rng.normal(0, 2.0, image.shape), 0, 255).astype(np.uint8)


class Swim:
    """Pictures of a sloping floor at several heights, and their depths in map units."""

    def __init__(self, heights_m: np.ndarray, depth_sigma: float = 0.01, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        self.views: list[BoardView] = []
        self.dots: list[np.ndarray] = []
        rays = CAMERA.unproject(CAMERA.pixel_centres())
        for height in heights_m:
            # The plane z = height + 0.2 x.
            z = height / (1.0 - 0.2 * rays[..., 0])
            z_beam = height + 0.2 * BEAMS[:, 0]
            self.dots.append(CAMERA.project(np.column_stack([BEAMS, z_beam])))
            units = z * np.exp(rng.normal(0.0, depth_sigma)) / METRES_PER_UNIT
            rho = 1.0 / units
            variance = (depth_sigma * rho) ** 2
            self.views.append(BoardView(CAMERA, Sim3.identity(), 0, rho, variance))

    def lengths(self, extra: np.ndarray | None = None) -> list[KnownLength]:
        """By pictures that also show ``extra`` [P, K, 2] spots of the colour."""
        found = []
        for k, dots in enumerate(self.dots):
            spots = dots if extra is None else np.vstack([dots, extra[k]])
            found.append(find_dots(k, dotted(spots, seed=k), "green"))
        return laser_lengths(found, lambda index: self.views[index], LASERS)


HEIGHTS = np.linspace(0.7, 1.8, 8)
