"""What moves by itself contradicts the learned depth: its own, its match, or the colours there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aquaflow.config.tracking import LearnedConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.tracking.current_keyframe import SeenBefore, moving
from aquaflow.tracking.learned import add_learned
from tests.tracking.learned.learned_scenes import KNOWN_SIGMA, TRUTH, measured, network
from tests.tracking.tracking_scenes import CAMERA

FISH = np.s_[60:100, 100:150]
T = Sim3(np.eye(3), np.array([0.12, 0.03, 0.02]))
SHAPE = (CAMERA.height, CAMERA.width)


def texture(
    pixels: np.ndarray,  # [H, W, 2] px
) -> np.ndarray:
    """[H, W, 3] smooth waves of colour."""
    x, y = pixels[..., 0], pixels[..., 1]
    waves = [np.sin(x / 9.0) + np.sin(y / 7.0), np.sin((x + y) / 11.0), np.cos((x - y) / 8.0)]
    return np.clip(128.0 + 35.0 * np.stack(waves, -1), 0, 255).astype(np.uint8)


def still() -> SeenBefore:
    """A still scene: matches and colours are where the true depth puts them."""
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    matches = CAMERA.project(T.apply(rays * TRUTH[..., None])).astype(np.float32)
    now, before = texture(matches), texture(CAMERA.pixel_centres())
    return SeenBefore(CAMERA, T, matches, np.ones(SHAPE, bool), before, now)


def found(pointmap: Pointmap, seen: SeenBefore, sigma: float = 0.05) -> np.ndarray:
    depth = add_learned(pointmap, *network(sigma=sigma), KNOWN_SIGMA, LearnedConfig())
    assert depth is not None
    return moving(pointmap, depth, seen)


def assert_only_the_fish(moves: np.ndarray) -> None:
    assert moves[FISH].mean() > 0.95
    moves = moves.copy()
    moves[54:106, 94:156] = False
    assert not moves.any()


@pytest.mark.parametrize("sigma", [0.02, 0.05, 0.15])
def test_nothing_moves_in_a_still_scene_however_much_the_network_errs(sigma: float) -> None:
    assert not found(measured(), still(), sigma).any()


def test_a_fish_that_swims_along_has_a_false_depth() -> None:
    """It swims with the camera, so that its parallax says that it is twice as far."""
    pointmap = measured(share=1.0)
    pointmap.rho[FISH] *= 0.5
    pointmap.variance[FISH] *= 0.25
    assert_only_the_fish(found(pointmap, replace(still(), before=None)))


@pytest.mark.parametrize("off_px", [(0.0, 6.0), (25.0, 6.0), (-25.0, 0.0)])
def test_a_fish_has_its_match_elsewhere(off_px: tuple[float, float]) -> None:
    seen = still()
    seen.matches[FISH] += np.array(off_px, np.float32)
    assert_only_the_fish(found(measured(share=0.35), replace(seen, before=None)))


def test_a_fish_without_a_match_has_other_colours_than_the_keyframe_there() -> None:
    seen = still()
    seen.matched[FISH] = False
    seen.now[FISH] = (40, 60, 30)
    assert_only_the_fish(found(measured(share=0.35), seen))


def test_a_plain_floor_without_matches_is_no_fish() -> None:
    seen = still()
    seen.matched[FISH] = False
    assert not found(measured(share=0.35), seen).any()


def test_new_light_on_the_whole_scene_is_no_fish() -> None:
    seen = still()
    seen.matched[FISH] = False
    brighter = np.clip(seen.now.astype(np.float32) + 20.0, 0, 255).astype(np.uint8)
    assert not found(measured(share=0.35), replace(seen, now=brighter)).any()


def test_what_the_keyframe_did_not_see_is_no_fish() -> None:
    seen = still()
    outside = (seen.matches < 0.0).any(-1) | (seen.matches > [CAMERA.width, CAMERA.height]).any(-1)
    assert outside.any()
    seen.matched[outside] = False
    seen.now[outside] = (40, 60, 30)
    assert not found(measured(share=0.35), seen).any()


def test_single_pixels_are_no_fish() -> None:
    pointmap = measured(share=1.0)
    pointmap.rho[::5, ::5] *= 0.5
    assert not found(pointmap, still()).any()


def test_without_a_match_and_without_the_keyframes_picture_nothing_is_said() -> None:
    seen = still()
    seen.matched[:] = False
    assert not found(measured(share=0.35), replace(seen, before=None)).any()
    seen.now[FISH] = (40, 60, 30)
    assert not found(measured(share=0.35), seen).any()
