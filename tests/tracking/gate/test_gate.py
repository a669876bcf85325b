"""The frame gate: what cannot help is skipped, everything else passes, and never for ever."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.config import GateConfig
from aquaflow.tracking.gate import TILES, FrameGate, GateKind, GateVerdict, _tile_means
from tests.tracking.tracking_scenes import CAMERA, SeaFloor, lawn_path, pose

Picture = npt.NDArray[np.uint8]

FLOOR = SeaFloor()
STILL = FLOOR.picture(pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
DUPLICATE_PX = 0.3 / 480.0 * CAMERA.width


def shifted(picture: Picture, dx: float, dy: float = 0.0) -> Picture:
    M = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]])
    size = (picture.shape[1], picture.shape[0])
    return cv2.warpAffine(picture, M, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def noisy(picture: npt.ArrayLike, seed: int, sigma: float = 1.3) -> Picture:
    values = np.asarray(picture, dtype=np.float64)
    noise = np.random.default_rng(seed).normal(0.0, sigma, values.shape)
    return np.clip(np.rint(values + noise), 0, 255).astype(np.uint8)


def swim(count: int = 6) -> list[Picture]:
    return [FLOOR.picture(T) for T in lawn_path(count)]


def judged(pictures: list[Picture], config: GateConfig | None = None) -> list[GateVerdict]:
    gate = FrameGate(config or GateConfig())
    return [gate.judge(picture) for picture in pictures]


def kinds(pictures: list[Picture], config: GateConfig | None = None) -> list[GateKind]:
    return [verdict.kind for verdict in judged(pictures, config)]


# --- duplicates -----------------------------------------------------------------------------------


def test_a_swim_passes_without_a_word() -> None:
    verdicts = judged(swim(12))
    assert all(verdict.passed and not verdict.reason for verdict in verdicts)


@pytest.mark.parametrize("sigma", [0.0, 1.3, 4.0])
def test_the_same_view_is_a_duplicate_whatever_the_noise(sigma: float) -> None:
    found = kinds([noisy(STILL, seed, sigma) for seed in range(5)])
    assert found == [GateKind.PASS] + [GateKind.DUPLICATE] * 4


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (-0.6, 0.8)])
@pytest.mark.parametrize(("share", "kind"), [(0.5, GateKind.DUPLICATE), (1.6, GateKind.PASS)])
def test_motion_is_told_from_noise_at_a_fraction_of_a_pixel(
    direction: tuple[float, float], share: float, kind: GateKind
) -> None:
    dx, dy = (share * DUPLICATE_PX * d for d in direction)
    verdict = judged([noisy(STILL, 0), noisy(shifted(STILL, dx, dy), 1)])[1]
    assert verdict.kind is kind
    assert 0.7 < verdict.measure * CAMERA.width / (share * DUPLICATE_PX) < 1.8


def test_slow_drift_adds_up_until_it_is_seen() -> None:
    step = 0.2 * DUPLICATE_PX
    found = kinds([noisy(shifted(STILL, step * i), i) for i in range(24)])
    assert 3 <= found[1:].count(GateKind.PASS) <= 6


@pytest.mark.parametrize("distance", [3.0, 8.0, 25.0, 60.0])
def test_large_motion_is_no_duplicate_and_no_number(distance: float) -> None:
    verdict = judged([STILL, shifted(STILL, distance)])[1]
    assert verdict.passed
    assert np.isinf(verdict.measure)


def test_a_grating_moved_by_half_its_period_is_no_duplicate() -> None:
    """Nothing moves to first order: the two gradients cancel."""
    y, x = np.indices(STILL.shape[:2])
    wave = 60.0 * (np.sin(2.0 * np.pi * x / 16.0) + np.sin(2.0 * np.pi * y / 16.0))
    before, after = (noisy(np.repeat(v[..., None], 3, 2), 1) for v in (127 + wave, 127 - wave))
    assert kinds([before, after])[1] is GateKind.PASS


def test_a_change_of_exposure_does_not_hide_a_duplicate() -> None:
    darker = np.rint(STILL * 0.8 + 5.0).astype(np.uint8)
    assert kinds([STILL, darker])[1] is GateKind.DUPLICATE


def test_a_fish_in_a_standing_picture_does_not_make_it_worth_tracking() -> None:
    fish = STILL.copy()
    fish[60:90, 100:150] = shifted(STILL, 40.0)[60:90, 100:150]
    assert kinds([STILL, fish])[1] is GateKind.DUPLICATE


def test_a_masked_vehicle_does_not_make_the_scene_stand_still() -> None:
    """Nine tenths of the picture are vehicle; only the rest may be looked at."""
    mask = np.zeros(STILL.shape[:2], bool)
    mask[:, -30:] = True
    moved = shifted(STILL, 1.0)
    moved[:, :-30] = STILL[:, :-30]
    gate = FrameGate(GateConfig())
    gate.judge(STILL, mask)
    assert gate.judge(moved, mask).passed


def test_after_a_loss_the_same_view_is_looked_at_again() -> None:
    gate = FrameGate(GateConfig())
    assert gate.judge(STILL).passed
    gate.forget()
    assert gate.judge(STILL).passed
    assert gate.judge(STILL).kind is GateKind.DUPLICATE


# --- pictures that show nothing -------------------------------------------------------------------


def night(picture: Picture) -> Picture:
    return noisy(picture * 0.004, 5, 1.0)


def silt(picture: Picture) -> Picture:
    return noisy(picture * 0.004 + 130.0, 6)


def glare(picture: Picture) -> Picture:
    return np.full_like(picture, 255)


def out_of_focus(picture: Picture) -> Picture:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.04 * CAMERA.width))


def smeared(picture: Picture) -> Picture:
    return np.asarray(cv2.blur(picture, (round(0.25 * CAMERA.width), 1)))


SPOILED: list[tuple[Callable[[Picture], Picture], GateKind]] = [
    (night, GateKind.DARK),
    (np.zeros_like, GateKind.DARK),
    (silt, GateKind.BLINDED),
    (glare, GateKind.BLINDED),
    (out_of_focus, GateKind.BLURRED),
    (smeared, GateKind.BLURRED),
]


@pytest.mark.parametrize(("change", "kind"), SPOILED)
def test_a_picture_that_shows_nothing_is_skipped_with_its_reason(
    change: Callable[[Picture], Picture], kind: GateKind
) -> None:
    pictures = swim()
    verdict = judged([*pictures, change(pictures[-1])])[-1]
    assert verdict.kind is kind
    assert kind.value in verdict.reason
    assert np.isfinite(verdict.measure)


@pytest.mark.parametrize(
    ("switch", "change"),
    [
        ("skip_dark", night),
        ("skip_blinded", silt),
        ("skip_blurred", out_of_focus),
        ("skip_duplicates", np.copy),
    ],
)
def test_every_skip_has_its_switch(switch: str, change: Callable[[Picture], Picture]) -> None:
    pictures = swim()
    pictures.append(change(pictures[-1]))
    assert not judged(pictures)[-1].passed
    assert judged(pictures, GateConfig.model_validate({switch: False}))[-1].passed


def hazy(picture: Picture) -> Picture:
    return noisy(picture * 0.15 + 110.0, 7)


def dim(picture: Picture) -> Picture:
    return noisy(picture * 0.1, 8, 1.0)


def slightly_soft(picture: Picture) -> Picture:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.006 * CAMERA.width))


@pytest.mark.parametrize("change", [hazy, dim, slightly_soft])
def test_a_poor_picture_that_can_still_be_tracked_passes(
    change: Callable[[Picture], Picture],
) -> None:
    *pictures, last = swim(7)
    assert judged([*pictures, change(last)])[-1].passed


def test_half_a_picture_of_glare_passes_for_the_other_half() -> None:
    picture = STILL.copy()
    picture[:, :150] = 255
    assert judged([picture])[0].passed


def test_a_whole_dive_in_soft_water_is_not_blurred() -> None:
    assert all(verdict.passed for verdict in judged([out_of_focus(p) for p in swim(12)]))


# --- never for ever -------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [night, silt])
def test_a_long_blackout_is_handed_to_tracking_which_has_to_know(
    change: Callable[[Picture], Picture],
) -> None:
    config = GateConfig(longest_run=3)
    good = swim(12)
    verdicts = judged([*good[:6], *(change(p) for p in good[:8]), *good[6:]], config)
    passed = [verdict.passed for verdict in verdicts]
    assert passed == [True] * 6 + [False] * 3 + [True] * 11
    assert "3 such frames" in verdicts[9].reason
    assert not verdicts[14].reason


def test_water_that_stays_soft_becomes_the_new_usual() -> None:
    config = GateConfig(longest_run=3)
    verdicts = judged([*swim(6), *(out_of_focus(p) for p in swim(12))], config)
    passed = [verdict.passed for verdict in verdicts]
    assert passed == [True] * 6 + [False] * 3 + [True] * 9
    assert not verdicts[-1].reason


def test_the_count_starts_anew_after_a_good_frame() -> None:
    config = GateConfig(longest_run=2)
    good = swim(8)
    pictures = [*good[:5], night(good[0]), night(good[0]), good[5], night(good[0]), night(good[0])]
    assert kinds(pictures, config)[5:] == [
        GateKind.DARK,
        GateKind.DARK,
        GateKind.PASS,
        GateKind.DARK,
        GateKind.DARK,
    ]


def test_a_run_of_nothing_allowed_skips_nothing() -> None:
    config = GateConfig(longest_run=0)
    assert judged([*swim(), np.zeros_like(STILL)], config)[-1].passed


@pytest.mark.parametrize("size", [(16, 16), (16, 200), (2000, 17), (1080, 1920)])
def test_pictures_of_any_size_are_judged(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (*size, 3), dtype=np.uint8)
    gate = FrameGate(GateConfig())
    for mask in (None, np.ones(size, bool), np.zeros(size, bool)):
        assert np.isnan(measure := gate.judge(picture, mask).measure) or measure >= 0.0


def test_the_same_stream_gets_the_same_verdicts() -> None:
    pictures = [noisy(p, i) for i, p in enumerate(swim(8))]
    assert repr(judged(pictures)) == repr(judged(pictures))


@pytest.mark.parametrize("shape", [(9, 12), (90, 160), (104, 160), (157, 240), (7, 5)])
def test_a_tiles_mean_is_that_of_its_area(shape: tuple[int, int]) -> None:
    """Also where a tile ends within a pixel."""
    pictures = np.random.default_rng(0).random((3, *shape), np.float32)
    columns, rows = TILES
    large = np.kron(pictures, np.ones((1, rows, columns)))
    expected = large.reshape(3, rows, shape[0], columns, shape[1]).mean((2, 4))
    np.testing.assert_allclose(_tile_means(pictures), expected, atol=1e-6)
