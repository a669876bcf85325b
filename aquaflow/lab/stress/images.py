"""Pictures that show nothing, too much, or something else: they cost those frames, not the dive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.config import SourceConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.lab.stress.case import Check, case
from aquaflow.lab.stress.swim import (
    CAMERA,
    FRAMES,
    Floor,
    Picture,
    clear_swim,
    clear_tracking,
    film,
    on_path,
    only_these_lost,
    path,
    sound,
    spoil,
    track,
)
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.sources.preprocessing import Preparation
from aquaflow.types import Frame

HURT = 2
"""Frames in a row that show nothing: fewer than what starts a new sub-map."""


def _worst_moment(seed: int) -> range:
    """The frames right after a keyframe, for which no motion is predicted yet.

    There flow starts from nothing, and onto an empty picture it ends there: a match everywhere.
    """
    keyframes = [k.frame_index for k in clear_tracking(seed).keyframes.keyframes]
    after = max(k for k in keyframes if k + HURT + 1 < FRAMES) + 1
    return range(after, after + HURT)


def _blind(check: Check, seed: int, change: Callable[[Picture, int], Picture]) -> None:
    """Frames that show nothing get no pose; all others keep theirs, and it is right."""
    hurt = _worst_moment(seed)
    frames = spoil(clear_swim(seed), hurt, change)
    result = track(frames)
    sound(check, frames, result)
    only_these_lost(check, result, hurt, share=0.9)
    on_path(check, result, path())


def _empty(check: Check, seed: int, grey: int) -> None:
    """A picture of one colour: not one pixel of it is matched, and its frames get no pose."""
    prior, seen = ClassicalPrior(), clear_swim(seed)[0].image
    pair = prior.decode(prior.encode(seen, CAMERA), prior.encode(np.full_like(seen, grey), CAMERA))
    check.below("matched share of an empty picture", float(pair.valid.mean()), 1e-3)
    _blind(check, seed, lambda picture, i: np.full_like(picture, grey))


def _hard(check: Check, seed: int, change: Callable[[Picture, int], Picture]) -> None:
    """Pictures that still show the place: seven tenths are placed, and placed right."""
    frames = spoil(clear_swim(seed), range(FRAMES), change)
    result = track(frames)
    sound(check, frames, result)
    only_these_lost(check, result, (), share=0.7)
    on_path(check, result, path())


@case("images", "prior.flow.MIN_TEXTURE")
def black(check: Check, seed: int) -> None:
    """Two black pictures, as when the lamps fail at night."""
    _empty(check, seed, 0)


@case("images", "prior.flow.MIN_TEXTURE")
def white(check: Check, seed: int) -> None:
    """Two white pictures, as when the camera looks into the sun."""
    _empty(check, seed, 255)


@case("images", "prior.flow.MIN_TEXTURE")
def constant(check: Check, seed: int) -> None:
    """Two pictures of open water."""
    _empty(check, seed, 60)


@case("images", "prior.flow.FORWARD_BACKWARD_PX")
def one_pixel_texture(check: Check, seed: int) -> None:
    """Two checkerboards of one-pixel squares: every match is as good as every other."""

    def checkerboard(picture: Picture, i: int) -> Picture:
        row, column, _ = np.indices(picture.shape)
        return np.asarray(np.where((row + column + i) % 2 == 0, 255, 0), dtype=np.uint8)

    _blind(check, seed, checkerboard)


@case("images", "prior.flow.FlowMatcher")
def salt_and_pepper(check: Check, seed: int) -> None:
    """One pixel in fifty black or white, in every picture."""

    def sprinkle(picture: Picture, i: int) -> Picture:
        rng = np.random.default_rng([seed, i])
        hit = rng.random(picture.shape[:2]) < 0.02
        salted = picture.copy()
        salted[hit] = np.where(rng.random((int(hit.sum()), 1)) < 0.5, 0, 255)
        return salted

    _hard(check, seed, sprinkle)


@case("images", "prior.flow.normalised_grey")
def saturation(check: Check, seed: int) -> None:
    """Over-exposed: half the picture is at 255."""
    _hard(check, seed, lambda p, i: np.clip(p.astype(np.float64) * 2.0, 0, 255).astype(np.uint8))


@case("images", "prior.flow.normalised_grey")
def lamp_on_and_off(check: Check, seed: int) -> None:
    """A lamp with a bright middle goes on and off every third frame."""

    def light(picture: Picture, i: int) -> Picture:
        y, x = np.indices(picture.shape[:2])
        middle = np.exp(-((x - CAMERA.cx) ** 2 + (y - CAMERA.cy) ** 2) / 60.0**2)
        gain = 0.35 + 0.8 * middle * (i // 3 % 2)
        return np.asarray(np.clip(picture * gain[..., None], 0, 255), dtype=np.uint8)

    _hard(check, seed, light)


@case("images", "prior.flow.normalised_grey")
def exposure_steps(check: Check, seed: int) -> None:
    """Exposure jumps by a factor of three from frame to frame."""
    gains = (0.5, 1.5, 0.8)
    _hard(check, seed, lambda p, i: np.clip(p * gains[i % 3], 0, 255).astype(np.uint8))


@case("images", "tracking.current_keyframe.KeyframeTracker.classify")
def snow(check: Check, seed: int) -> None:
    """Two seconds of marine snow over two fifths of the picture: it makes no keyframe."""
    camera, poses, snowy = CAMERA.resize(320, 240), path(34, step_m=0.015), range(8, 28)
    clear = film(Floor(seed), poses, camera)
    frames = spoil(clear, snowy, marine_snow(camera, 0.4, seed))
    result = track(frames)
    sound(check, frames, result)
    only_these_lost(check, result, (), share=0.9)
    on_path(check, result, poses, bound=0.02)
    keyframes = {k.frame_index for k in result.keyframes.keyframes}
    check.true("no keyframe shows snow", not keyframes & set(snowy))


@case("images", "sources.preprocessing.check_picture")
def nan_in_float_picture(check: Check, seed: int) -> None:
    """A source that hands over floats, some of them NaN, is refused in one sentence."""
    frame = clear_swim(seed)[0]
    floats = frame.image.astype(np.float32) / 255.0
    floats[::7] = np.nan
    wrong = replace(frame, image=floats)  # type: ignore[arg-type]
    check.true("a float picture is refused", _is_refused(wrong))


@case("images", "sources.preprocessing.check_picture")
def one_by_one(check: Check, seed: int) -> None:
    """Pictures of one pixel are refused in one sentence."""
    camera = CameraModel(1, 1, 1.0, 1.0, 0.5, 0.5)
    image = np.full((1, 1, 3), seed % 256, np.uint8)
    check.true("a picture of one pixel is refused", _is_refused(Frame(0, 0, 0, image, camera)))


@case("images", "sources.preprocessing.Preparation")
def width_8192(check: Check, seed: int) -> None:
    """Pictures 8192 pixels wide are made small, then tracked."""
    large = CAMERA.resize(8192, 6144)
    floor, prepare = Floor(seed), Preparation(SourceConfig(width=CAMERA.width), large)
    frames = []
    for frame in film(floor, path(6)):
        wide = np.repeat(np.repeat(frame.image, 52, axis=0)[:6144], 52, axis=1)[:, :8192]
        frames.append(prepare(replace(frame, image=np.ascontiguousarray(wide), camera=large)))
    result = track(frames)
    sound(check, frames, result)
    only_these_lost(check, result, (), share=0.8)


def _is_refused(frame: Frame) -> bool:
    try:
        Preparation(SourceConfig(), None)(frame)
    except InputError:
        return True
    return False


# --------------------------------------------------------------------------------------------------
# Marine snow: opaque bright flakes that drift through the picture on their own ways.

RADIUS_WIDTHS = (0.01, 0.035)
"""Smallest and largest flake: some millimetres, a hand's breadth from the lens."""
DRIFT_WIDTHS = 0.015
"""Of all flakes together, per frame: 0.15 widths/s at 10 frames/s."""
OWN_WIDTHS = 0.008
"""Standard deviation, per frame, of each flake's own way."""
BRIGHTNESS = (190, 255)
"""Grey levels: flakes near the lens are close to overexposed."""
SUBPIXEL_BITS = 4
"""Fractional bits of OpenCV's coordinates: flakes move by a sixteenth of a pixel."""
EDGE_PX = 1.1
"""OpenCV draws a disc so much wider than its radius."""


def marine_snow(
    camera: CameraModel, cover: float, seed: int, first: int = 0
) -> Callable[[Picture, int], Picture]:
    """Puts flakes over the share ``cover`` of the picture with a given index.

    They move steadily from frame ``first`` on; one that leaves comes in on the other side.
    """
    rng = np.random.default_rng([seed, 40])
    size = np.array([camera.width, camera.height])
    margin = RADIUS_WIDTHS[1] * camera.width
    span = size + 2.0 * margin
    # A drawn disc reaches most of a pixel further than its radius.
    reach = np.linspace(*RADIUS_WIDTHS, 100) * camera.width + EDGE_PX
    mean_area = np.pi * float(np.mean(reach**2))
    # Flakes overlap: of n at random places, exp(-n area / span) of the picture stays free.
    count = round(-np.log(1.0 - cover) * float(span.prod()) / mean_area)
    radius = rng.uniform(*RADIUS_WIDTHS, count) * camera.width
    start = rng.uniform(0.0, 1.0, (count, 2)) * span
    angle = rng.uniform(0.0, 2.0 * np.pi)
    drift = DRIFT_WIDTHS * np.array([np.cos(angle), np.sin(angle)])
    velocity = (drift + OWN_WIDTHS * rng.standard_normal((count, 2))) * camera.width
    grey = rng.integers(*BRIGHTNESS, count)

    def snow(picture: Picture, index: int) -> Picture:
        covered = picture.copy()
        centres = (start + velocity * (index - first)) % span - margin
        unit = 1 << SUBPIXEL_BITS
        for (x, y), r, level in zip(centres * unit, radius * unit, grey, strict=True):
            colour = (int(level),) * 3
            centre = (round(x), round(y))
            cv2.circle(covered, centre, round(r), colour, -1, cv2.LINE_AA, SUBPIXEL_BITS)
        return covered

    return snow
