"""What the camera adds: marine snow in front of it, lamp vignetting, noise, eight bits."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.optics import pixels_of_points
from aquaflow.lab.synthetic.config import Lamps, SyntheticConfig
from aquaflow.lab.synthetic.lamps import SyntheticLampLight
from aquaflow.lab.synthetic.water import Medium

Array: TypeAlias = npt.NDArray[np.float64]
Image: TypeAlias = npt.NDArray[np.float32]

SNOW_RANGE_M = (0.15, 2.5)
"""Nearer particles are too blurred to see, farther ones too small."""
SNOW_SIZE_M = (0.0004, 0.0015)
"""Radius of a particle; visible marine snow is 0.5 to several mm across."""
SNOW_ALBEDO = 0.75
"""Of a particle."""
CURRENT_M_S = np.array([0.015, 0.03, 0.008])
"""Drift of the particles over ground, survey frame: a slight current, and sinking."""
BLUR_PX = 0.55
"""Sigma of the lens, at 480 px width."""


class Snow:
    """Particles that hang in the water and drift; they stay the same from picture to picture."""

    def __init__(
        self,
        config: SyntheticConfig,
        centres: Array,  # [N, 3] m, every camera position, survey frame
        rng: np.random.Generator,
    ) -> None:
        reach = SNOW_RANGE_M[1] + CURRENT_M_S * config.duration_s
        low, high = centres.min(axis=0) - reach, centres.max(axis=0) + reach
        count = int(rng.poisson(config.snow_per_m3 * float(np.prod(high - low))))
        self._position = rng.uniform(low, high, (count, 3))
        self._radius = rng.uniform(*SNOW_SIZE_M, count)

    def draw(
        self,
        image: Image,  # [H, W, 3], changed in place
        range_m: Image,  # [H, W] m, what hides particles behind it
        camera: CameraModel,
        R_sc: Array,  # [3, 3]
        centre: Array,  # [3] m
        t_s: float,
        medium: Medium,
        lamps: Lamps | None = None,
    ) -> None:
        """Blend the particles that are in view over ``image``."""
        light = (
            None
            if lamps is None
            else SyntheticLampLight.of_camera(lamps, medium, np.eye(3), np.zeros(3))
        )
        local = (self._position + CURRENT_M_S * t_s - centre) @ R_sc
        distance = np.linalg.norm(local, axis=1)
        seen = (local[:, 2] > 0.0) & (distance > SNOW_RANGE_M[0]) & (distance < SNOW_RANGE_M[1])
        pixels = np.full((len(local), 2), np.nan)
        pixels[seen] = pixels_of_points(camera, local[seen])
        size = np.array([camera.width, camera.height])
        seen &= ((pixels > -4.0) & (pixels < size + 4.0)).all(axis=1)
        for k in np.flatnonzero(seen).tolist():
            colour = _lit(local[k], float(distance[k]), medium, light)
            self._blend(image, range_m, pixels[k], float(distance[k]), k, camera, colour)

    def _blend(
        self,
        image: Image,  # [H, W, 3], changed in place
        range_m: Image,  # [H, W] m
        pixel: Array,  # [2] px
        distance: float,
        k: int,
        camera: CameraModel,
        colour: Array,  # [3] as it reaches the camera
    ) -> None:
        radius = camera.fx * self._radius[k] / distance
        # Out of focus when near: the blur disc grows with 1 / distance.
        blur = BLUR_PX * camera.width / 480.0 * (1.0 + 0.25 / distance)
        sigma = float(np.hypot(blur, 0.6 * radius))
        x0, y0 = (max(0, int(p - 3.0 * sigma)) for p in pixel)
        x1 = min(camera.width, int(pixel[0] + 3.0 * sigma) + 1)
        y1 = min(camera.height, int(pixel[1] + 3.0 * sigma) + 1)
        if x1 <= x0 or y1 <= y0:
            return
        x = np.arange(x0, x1) + 0.5 - pixel[0]
        y = np.arange(y0, y1) + 0.5 - pixel[1]
        fall = np.exp(-(x[None, :] ** 2 + y[:, None] ** 2) / (2.0 * sigma**2))
        # The light of the disc, spread over the blur.
        opacity = fall * min(0.9, radius**2 / (2.0 * sigma**2))
        opacity = opacity * (range_m[y0:y1, x0:x1] > distance)
        window = image[y0:y1, x0:x1]
        window += (opacity[..., None] * (colour - window)).astype(np.float32)


def _lit(
    place: Array,  # [3] m, camera axes
    distance: float,
    medium: Medium,
    light: SyntheticLampLight | None,  # in camera axes
) -> Array:
    """[3] a particle as it reaches the camera."""
    J, t = np.full((1, 3), SNOW_ALBEDO), np.array([distance])
    if light is None:
        return np.asarray(medium.compose(J, t)[0])
    ray = place[None] / distance
    return np.asarray(light.compose(J, np.zeros(3), ray, t, -ray)[0])


def vignette(camera: CameraModel, strength: float) -> Image:
    """[H, W] factor: 1 in the centre, ``1 - strength`` in the corners, quadratic between."""
    at = camera.pixel_centres() - (camera.width / 2.0, camera.height / 2.0)
    corner = 0.25 * (camera.width**2 + camera.height**2)
    return np.asarray(1.0 - strength * (at**2).sum(axis=-1) / corner, np.float32)


def expose(
    water: Image,  # [H, W, 3]
    shade: Image,  # [H, W] from vignette
    sigma: float,
    rng: np.random.Generator,
) -> npt.NDArray[np.uint8]:
    """The stored picture: shaded, noisy, eight bits."""
    image = water * shade[..., None]
    if sigma > 0.0:
        image += np.float32(sigma) * rng.standard_normal(image.shape, dtype=np.float32)
    return quantise(image)


def quantise(
    image: Image,  # [H, W, 3]
) -> npt.NDArray[np.uint8]:
    """Radiance in [0, 1] as 0 to 255, linear, clipped."""
    return np.asarray(np.rint(np.clip(image, 0.0, 1.0) * 255.0), np.uint8)
