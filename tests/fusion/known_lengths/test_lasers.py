"""Two laser dots of known spacing: found, paired by their beams, measured, else refused."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
import pytest

from aquaflow.config.known_lengths import LasersConfig
from aquaflow.fusion.known_lengths.board_size import PosedView
from aquaflow.fusion.known_lengths.known_length import KnownLength, scale_of
from aquaflow.fusion.known_lengths.laser_dots import find_dots
from aquaflow.fusion.known_lengths.laser_spacing import laser_lengths
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3

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
        self.views: list[PosedView] = []
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
            self.views.append(PosedView(CAMERA, Sim3.identity(), 0, rho, variance))

    def lengths(self, extra: np.ndarray | None = None) -> list[KnownLength]:
        """By pictures that also show ``extra`` [P, K, 2] spots of the colour."""
        found = []
        for k, dots in enumerate(self.dots):
            spots = dots if extra is None else np.vstack([dots, extra[k]])
            found.append(find_dots(k, dotted(spots, seed=k), "green"))
        return laser_lengths(found, lambda index: self.views[index], LASERS)


HEIGHTS = np.linspace(0.7, 1.8, 8)


@pytest.mark.parametrize("colour", ["red", "green", "blue"])
def test_dots_are_found_to_a_fraction_of_a_pixel(colour: Colour) -> None:
    true = np.array([[200.3, 301.8], [420.6, 288.1]])
    found = find_dots(0, dotted(true, colour), colour).pixels
    assert found.shape == (2, 2)
    assert np.abs(found[np.argsort(found[:, 0])] - true).max() < 0.3


def test_what_is_of_another_colour_dim_large_or_long_is_no_dot() -> None:
    assert len(find_dots(0, dotted(np.array([[200.0, 300.0]]), "red"), "green").pixels) == 0
    assert len(find_dots(0, dotted(np.empty((0, 2))), "green").pixels) == 0
    weed = dotted(np.empty((0, 2)))
    weed[100:104, 100:300] = (20, 250, 30)
    weed[200:260, 200:260] = (20, 250, 30)
    weed[300:306, 300:306] = (20, 150, 30)
    assert len(find_dots(0, weed, "green").pixels) == 0


def test_the_dots_of_a_dive_give_the_metres_of_a_map_unit() -> None:
    lengths = Swim(HEIGHTS).lengths()
    assert [length.frame_index for length in lengths] == list(range(8))
    errors = [np.log(each.metres_per_unit / METRES_PER_UNIT) for each in lengths]
    assert np.abs(errors).max() < 0.05
    assert all(
        abs(error) < 3.5 * each.relative_sigma for error, each in zip(errors, lengths, strict=True)
    )
    scale = scale_of(lengths)
    assert scale is not None
    assert scale.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=0.02)


def test_spots_of_the_same_colour_do_not_take_the_place_of_the_dots() -> None:
    rng = np.random.default_rng(9)
    swim = Swim(HEIGHTS)
    weed = rng.uniform([40, 40], [600, 200], (len(HEIGHTS), 4, 2))
    plain, among = swim.lengths(), swim.lengths(weed)
    assert [each.frame_index for each in among] == [each.frame_index for each in plain]
    for a, b in zip(plain, among, strict=True):
        assert a.metres_per_unit == pytest.approx(b.metres_per_unit, rel=0.01)


def test_dirt_on_the_window_is_no_beam() -> None:
    swim = Swim(HEIGHTS)
    swim.dots = [np.array([[250.0, 300.0], [380.0, 310.0]]) for _ in HEIGHTS]
    assert swim.lengths() == []


def test_spots_that_wander_are_no_beams() -> None:
    rng = np.random.default_rng(4)
    swim = Swim(HEIGHTS)
    swim.dots = [rng.uniform([60, 60], [580, 420], (2, 2)) for _ in HEIGHTS]
    assert swim.lengths() == []


def test_too_few_pictures_or_no_depth_give_no_length() -> None:
    assert Swim(HEIGHTS[:4]).lengths() == []
    blind = Swim(HEIGHTS)
    blind.views = [PosedView(CAMERA, Sim3.identity(), 0) for _ in HEIGHTS]
    assert blind.lengths() == []


def test_beams_that_may_lean_make_a_far_picture_less_certain() -> None:
    near, *_, far = Swim(HEIGHTS).lengths()
    assert far.sigma_m > 1.5 * near.sigma_m
