"""Hours at one place: a vehicle that hovers, wanders, turns, leaves and comes back.

Pictures are made one at a time, a millisecond each at 160 px, so that two hours need no disk; a
frame of a given index is the same each time.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.stress.images import marine_snow
from aquaflow.lab.stress.swim import CAMERA, FRAME_NS, Array, Picture, pose
from aquaflow.types import Frame

FPS = 1e9 / FRAME_NS
DEPTH_M, RELIEF_M = 1.6, 0.25
"""Of the floor below the vehicle, and about that mean."""
SIZE, TEXELS_PER_M = 1024, 80.0
"""The floor is 12.8 m wide, further than the vehicle gets."""
TEXTURE = ((1.3, 1.0), (3.0, 1.2), (9.0, 1.3))
"""Standard deviation of each layer's blur in texels, and its weight."""
ITERATIONS = 8
"""Of a ray's intersection with the floor; each leaves less than half of the error."""
WANDER_M = (0.45, 0.4, 0.2)
"""Amplitude along x, y and z."""
TURN_RAD = (0.06, 0.06, 0.4)
"""Amplitude about x, y and z."""
LEAVE_EVERY_S, AWAY_S = 20.0, 9.0
"""The vehicle leaves so often, for so long: 360 times in two hours."""
LEAVE_M, WAYS = 2.2, 3
"""Out of sight of the place, in one of so many directions."""
LIGHT_S, LIGHT = 47.0, 0.3
"""Period and amplitude of the light's change."""
SNOW_COVER, NOISE = 0.02, 1.5
"""Share of the picture behind flakes; standard deviation of a pixel in grey levels."""
PERIODS_S = np.array([31.0, 43.0, 57.0, 67.0, 71.0, 103.0])
"""Of wander and turning: no two moments of two hours have the same pose."""


class OnePlace:
    """The place, its water, and the vehicle's way."""

    def __init__(self, seed: int = 0, camera: CameraModel = CAMERA) -> None:
        self.seed, self.camera = seed, camera
        rng = np.random.default_rng([seed, 2])
        texture = np.zeros((SIZE, SIZE))
        for sigma, weight in TEXTURE:
            texture += weight * _smooth(rng, sigma)
        self._texture = (120.0 + 34.0 * texture / texture.std()).astype(np.float32)
        relief = _smooth(rng, 0.9 * TEXELS_PER_M) + 0.35 * _smooth(rng, 0.25 * TEXELS_PER_M)
        self._floor = (DEPTH_M + RELIEF_M * relief / np.abs(relief).max()).astype(np.float32)
        self._phases = rng.uniform(0.0, 2.0 * np.pi, len(PERIODS_S))
        self._snow = marine_snow(camera, SNOW_COVER, seed)
        self._rays = camera.unproject(camera.pixel_centres()).astype(np.float32)

    def T_wc(self, index: int) -> Sim3:
        """The vehicle's pose at frame ``index``."""
        t = index / FPS
        s = np.sin(2.0 * np.pi * t / PERIODS_S + self._phases)
        xyz = s[:3] * WANDER_M
        round_, since = divmod(t, LEAVE_EVERY_S)
        if since < AWAY_S:
            out = LEAVE_M * np.sin(np.pi * since / AWAY_S) ** 2
            angle = 2.0 * np.pi * (round_ % WAYS) / WAYS
            xyz[:2] += (out * np.cos(angle), out * np.sin(angle))
        turn = s[3:] * TURN_RAD
        return pose((float(xyz[0]), float(xyz[1]), float(xyz[2])), tuple(turn.tolist()))

    def frame(self, index: int) -> Frame:
        """What the camera sees."""
        rng = np.random.default_rng([self.seed, 3, index])
        light = 1.0 + LIGHT * np.sin(2.0 * np.pi * index / FPS / LIGHT_S)
        grey = light * self._grey(self.T_wc(index))
        grey += NOISE * rng.standard_normal(grey.shape, np.float32)
        picture: Picture = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        t_ns = index * FRAME_NS
        return Frame(index, t_ns, t_ns, self._snow(picture, index), self.camera)

    def _grey(self, T_wc: Sim3) -> npt.NDArray[np.float32]:
        u, v = self._intersect_floor(T_wc)
        wrap = cv2.BORDER_WRAP
        return np.asarray(
            cv2.remap(self._texture, u, v, cv2.INTER_LINEAR, borderMode=wrap), dtype=np.float32
        )

    def _intersect_floor(self, T_wc: Sim3) -> tuple[npt.NDArray[np.float32], ...]:
        """[H, W] each: texel column and row of the floor that a pixel shows."""
        directions = self._rays @ T_wc.R.T.astype(np.float32)
        x, y, z = (float(value) for value in T_wc.t)
        along = np.full(directions.shape[:2], DEPTH_M - z, np.float32)
        for _ in range(ITERATIONS):
            u = (x + along * directions[..., 0]) * TEXELS_PER_M + SIZE / 2
            v = (y + along * directions[..., 1]) * TEXELS_PER_M + SIZE / 2
            floor = cv2.remap(self._floor, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            along = (floor - z) / directions[..., 2]
        return u, v


def _smooth(rng: np.random.Generator, sigma: float) -> Array:
    """[SIZE, SIZE] noise of unit variance that repeats at the edges."""
    noise = np.pad(rng.standard_normal((SIZE, SIZE)), SIZE // 4, mode="wrap")
    smooth = cv2.GaussianBlur(noise, (0, 0), sigma)[SIZE // 4 : -SIZE // 4, SIZE // 4 : -SIZE // 4]
    return np.asarray(smooth / smooth.std())
