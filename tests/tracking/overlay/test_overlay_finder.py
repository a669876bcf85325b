"""What is burned into the pictures is found and masked; what only stands still is not."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.camera import guess_camera
from aquaflow.lab.synthetic.display import burn_in
from aquaflow.tracking.overlay import OverlayFinder
from aquaflow.types import Frame

WIDTH, HEIGHT = 480, 360
CAMERA = guess_camera(WIDTH, HEIGHT)
STEP_PX = 17
FOUND_WITHIN = 8
"""Pictures a wide step apart; the clearest displays are found with the fourth."""

Picture = npt.NDArray[np.uint8]


def sea_floor() -> Picture:
    """[H, W', 3], wide enough for a swim along it."""
    rng = np.random.default_rng(3)
    total = np.zeros((HEIGHT, 1600), np.float64)
    for sigma in (1.5, 4.0, 12.0):
        layer = cv2.GaussianBlur(rng.normal(size=total.shape), (0, 0), sigma)
        total += layer / layer.std()
    grey = np.clip(120.0 + 25.0 * total, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


FLOOR = sea_floor()


def view(k: int, step_px: int = STEP_PX) -> Picture:
    noise = np.random.default_rng(k).normal(0.0, 1.0, (HEIGHT, WIDTH, 1))
    seen = FLOOR[:, k * step_px : k * step_px + WIDTH] + noise
    return np.clip(seen, 0, 255).astype(np.uint8)


def frame(k: int, image: Picture, mask: npt.NDArray[np.bool_] | None = None) -> Frame:
    return Frame(k, k, k, image, CAMERA, mask=mask)


def shown(k: int, display: str, step_px: int = STEP_PX) -> tuple[Picture, npt.NDArray[np.bool_]]:
    """A picture with a display, and where that is clearly visible."""
    plain = view(k, step_px)
    image = plain.copy()
    burn_in(image, display, float(k))
    return image, (np.abs(image.astype(int) - plain) > 40).any(axis=-1)


@pytest.mark.parametrize("display", ["clock", "clock_and_crosshair", "panel"])
def test_a_display_is_masked_within_a_few_pictures_with_its_changing_digits(display: str) -> None:
    finder, covered = OverlayFinder(), []
    for k in range(20):
        image, drawn = shown(k, display)
        masked = finder.mask(frame(k, image))
        if k >= FOUND_WITHIN:
            assert masked.mask is not None
            covered.append(float((~masked.mask)[drawn].mean()))
    assert min(covered) > 0.97
    assert finder.share < 0.16


def test_a_scene_without_a_display_is_not_masked() -> None:
    finder = OverlayFinder()
    assert all(finder.mask(frame(k, view(k))).mask is None for k in range(40))
    assert finder.share == 0.0


def test_a_vehicle_that_stands_still_keeps_its_scene() -> None:
    finder = OverlayFinder()
    for k in range(8):
        finder.mask(frame(k, view(k)))
    for k in range(8, 80):  # the same view, with the noise of another picture
        still = np.clip(FLOOR[:, 136 : 136 + WIDTH] + (k % 3), 0, 255).astype(np.uint8)
        assert finder.mask(frame(k, still)).mask is None


def test_fish_before_a_vehicle_that_stands_still_do_not_make_its_scene_an_overlay() -> None:
    finder = OverlayFinder()
    for k in range(60):
        image = view(0).copy()
        for fish in range(5):
            x = (40 * k + 90 * fish) % (WIDTH - 70)
            image[60 * fish : 60 * fish + 40, x : x + 70] = view(30 + k % 7)[:40, :70]
        assert finder.mask(frame(k, image)).mask is None


def test_a_display_is_found_where_the_vehicle_first_stood_still() -> None:
    finder = OverlayFinder()
    for k in range(30):
        image = view(0)
        burn_in(image, "clock", float(k))
        assert finder.mask(frame(k, image)).mask is None
    for k in range(1, 12):
        masked = finder.mask(frame(30 + k, shown(k, "clock")[0]))
    assert masked.mask is not None


def test_a_part_of_the_vehicle_that_is_always_in_view_is_masked() -> None:
    finder = OverlayFinder()
    arm = view(60)
    for k in range(16):
        image = view(k)
        image[HEIGHT - 80 :, 190:290] = arm[HEIGHT - 80 :, 190:290]
        masked = finder.mask(frame(k, image))
    assert masked.mask is not None
    assert (~masked.mask[HEIGHT - 80 :, 190:290]).mean() > 0.8
    assert masked.mask[:200].mean() > 0.99


def test_a_display_that_is_switched_off_is_given_back() -> None:
    finder = OverlayFinder()
    for k in range(12):
        masked = finder.mask(frame(k, shown(k, "clock")[0]))
    assert masked.mask is not None
    for k in range(12, 60):
        masked = finder.mask(frame(k, view(k)))
    assert masked.mask is None or masked.mask.mean() > 0.995


def test_a_source_s_own_mask_is_kept() -> None:
    finder = OverlayFinder()
    own = np.ones((HEIGHT, WIDTH), bool)
    own[:, :50] = False
    for k in range(12):
        masked = finder.mask(frame(k, shown(k, "clock")[0], own))
    assert masked.mask is not None
    assert not masked.mask[:, :50].any()
    assert not masked.mask[18:25, 60:150].any()


def test_small_pictures_are_looked_at_too() -> None:
    finder = OverlayFinder()
    for k in range(14):
        image = cv2.resize(shown(k, "clock")[0], (240, 180), interpolation=cv2.INTER_AREA)
        masked = finder.mask(frame(k, np.asarray(image)))
    assert masked.mask is not None
    assert 0.02 < 1.0 - masked.mask.mean() < 0.16
