"""The frame gate: useless pictures are skipped before any costly processing."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.config import GateConfig

FIRST_LEVELS = 3
"""Frames before sharpness has a level to fall from."""
DUPLICATE_WIDTHS = 0.3 / 480.0
"""Motion over width below which a frame is a duplicate; 0.3 px at 480 px is what a checked DIS
match is known to."""
STATIC_SHARE = 0.8
"""Part of the textured tiles that must stand still; fish move in the others."""
MIN_SNR = 2.0
"""Gradient of a textured tile over that of noise alone; measured: below 1.2 to 1.8 in the
median tile, flow finds no more than chance matches."""
MIN_USABLE = 0.05
"""Textured share of the picture that a pose can come from."""
DARK_LEVEL = 20.0
"""Grey level that separates dark from blinded, in the reason."""
BLUR_LOSS = 0.065
"""Sharpness left, of the running median; measured at 480 px: Gaussian blur of 5 px leaves 0.07
to 0.09 and still tracks, 8 px 0.04 to 0.06 and does not; good frames keep over 0.69."""
BLUR_MEMORY = 9
"""Frames that the running sharpness is taken from."""


class GateKind(str, Enum):
    """The gate's classes of frames."""

    PASS = "pass"
    DUPLICATE = "duplicate"
    DARK = "dark"
    BLURRED = "blurred"
    BLINDED = "blinded"


@dataclass(frozen=True)
class GateVerdict:
    """Whether a frame is tracked, and the measure that decided it."""

    kind: GateKind
    reason: str = ""
    """One clause for the dive's records; empty for an ordinary pass."""
    measure: float = float("nan")
    """For a duplicate and for an ordinary pass the motion in picture widths: infinite beyond some
    pixels, NaN without a frame to compare with. For dark and blinded the textured share of the
    picture; for blurred the sharpness over its running level."""

    @property
    def passed(self) -> bool:
        """True if the frame is tracked."""
        return self.kind is GateKind.PASS

    @property
    def same_place(self) -> bool:
        """True if the frame shows what the last one that passed showed."""
        return self.kind is GateKind.DUPLICATE


class FrameGate:
    """Judges frames in the order of the stream; the same frames get the same verdicts."""

    def __init__(self, config: GateConfig) -> None:
        self._config = config
        self._reference: Thumbnail | None = None
        self._levels: deque[Float] = deque(maxlen=BLUR_MEMORY)
        self._run = 0

    def judge(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
        mask: Mask | None = None,  # [H, W] True where the scene is seen
    ) -> GateVerdict:
        """The verdict on the next frame of the stream.

        Of frames that show nothing, only ``longest_run`` in a row are skipped; the following ones
        pass until one is good again: the tracker has to know that it sees nothing.
        """
        thumbnail = measure_thumbnail(image, mask, MIN_SNR)
        verdict = self._useless(thumbnail)
        if verdict is not None:
            return self._bound(verdict)
        self._run = 0
        verdict = self._compare(thumbnail)
        if verdict.passed:
            self._reference = thumbnail
            self._levels.append(thumbnail.sharpness)
        return verdict

    def forget(self) -> None:
        """Call when tracking lost the frame: later frames are no duplicates of it."""
        self._reference = None

    def _useless(self, thumbnail: Thumbnail) -> GateVerdict | None:
        """Dark, blinded or blurred; None for a picture that shows something."""
        config = self._config
        if thumbnail.usable < MIN_USABLE:
            says = f"texture above the noise in {100 * thumbnail.usable:.0f} % of the picture"
            dark = thumbnail.level < DARK_LEVEL
            if dark and config.skip_dark:
                return GateVerdict(GateKind.DARK, f"dark: {says}", thumbnail.usable)
            if not dark and config.skip_blinded:
                return GateVerdict(GateKind.BLINDED, f"blinded: {says}", thumbnail.usable)
            return None
        if not config.skip_blurred or len(self._levels) < FIRST_LEVELS:
            return None
        usual = np.median(np.stack(self._levels), axis=0)
        left = float((thumbnail.sharpness / np.maximum(usual, 1e-6)).min())
        if left >= BLUR_LOSS:
            return None
        return GateVerdict(
            GateKind.BLURRED, f"blurred: {100 * left:.0f} % of the usual sharpness", left
        )

    def _bound(self, verdict: GateVerdict) -> GateVerdict:
        self._run += 1
        if self._run <= self._config.longest_run:
            return verdict
        # From here on nothing that came before is a measure for what comes: water may have changed.
        self._reference = None
        self._levels.clear()
        reason = f"{verdict.reason}; {self._config.longest_run} such frames were skipped before it"
        return GateVerdict(GateKind.PASS, reason, verdict.measure)

    def _compare(self, thumbnail: Thumbnail) -> GateVerdict:
        """Against the last frame that passed, so that slow drift adds up until it is seen."""
        if not self._config.skip_duplicates or self._reference is None:
            return GateVerdict(GateKind.PASS)
        motion = motion_widths(self._reference, thumbnail, STATIC_SHARE)
        if motion >= DUPLICATE_WIDTHS:
            return GateVerdict(GateKind.PASS, measure=motion)
        reason = f"duplicate: moved by {100 * motion:.3f} % of the width since the last frame used"
        return GateVerdict(GateKind.DUPLICATE, reason, motion)


# --------------------------------------------------------------------------------------------------
# Measures of a small grey thumbnail: texture above the noise, sharpness, motion.
#
# Measured in tiles, so that one fish or one lamp does not decide for the whole picture, and at one
# size, so that it costs the same at every resolution.

Float = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

THUMBNAIL_WIDTH = 160
"""px; keeps the texture that tracking uses, removes most of the sensor's noise."""
TILES = (12, 9)
"""Columns and rows of tiles."""
COARSE_CELLS = 20
"""Width of the picture in which blur over 5 % of the width leaves the gradients alone."""
SATURATED = 250.0
"""Grey level from which a pixel counts as saturated."""
LEVEL_NOISE = 12.0**-0.5
"""Standard deviation of rounding to whole grey levels: the least noise of an 8-bit picture."""
NOISE_TAPS = np.array([1, -2, 1], np.float32)
"""Second difference, taken both ways: blind to planes and straight edges (Immerkaer 1996); its
response to white noise of sigma 1 has the standard deviation 6 and the mean size
6 sqrt(2 / pi)."""
NOISE_QUANTILE = 0.1
"""The calmest tiles show the noise, the others texture too."""
MOTION_SNR = 3.0
"""Signal to noise of a tile whose motion is measured: below, noise in the gradients shrinks it."""
SMOOTHING_PX = 1.0
"""Of the thumbnail: central differences see the steepest detail too flat, its motion too large."""
EXPOSURE_CHANGE = 2.0
"""Largest gain between two pictures of one view; unbounded it makes any two textures alike."""
LINEAR_PX = 0.5
"""Difference over gradient, in thumbnail pixels, up to which their quotient is a motion."""


@dataclass(frozen=True)
class Thumbnail:
    """A small grey version of one picture and the measures taken on it."""

    grey: Float
    """[h, w] grey levels, smoothed for motion."""
    seen: Float
    """[h, w] 1 where the scene is seen: not masked, not saturated."""
    snr: Float
    """[tiles] gradient over what the noise alone would give; 0 where little is seen."""
    usable: float
    """Share of the unmasked tiles that show texture above the noise."""
    level: float
    """Mean grey level."""
    sharpness: Float
    """[4] fine gradient energy in four directions over coarse energy: blur takes it, contrast does
    not change it."""


def measure_thumbnail(
    image: npt.NDArray[np.uint8],  # [H, W, 3]
    mask: Mask | None,  # [H, W]
    min_snr: float,
) -> Thumbnail:
    """Measure everything but motion; a tile with at least ``min_snr`` has texture."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    height, width = grey.shape
    small_width = min(THUMBNAIL_WIDTH, width)
    size = (small_width, max(round(height * small_width / width), TILES[1]))
    thumbnail = _shrunk(grey.astype(np.float32), size)
    scene = np.ones_like(thumbnail)
    if mask is not None:
        # Half-masked pixels would show the mask's edge, not the scene's.
        scene = (_shrunk(mask.astype(np.float32), size) > 0.99).astype(np.float32)
    seen = scene * (thumbnail < SATURATED)
    response = np.abs(np.asarray(cv2.sepFilter2D(grey, cv2.CV_32F, NOISE_TAPS, NOISE_TAPS)))
    sigma = float(np.quantile(_tile_means(response), NOISE_QUANTILE)) * np.sqrt(np.pi / 2) / 6
    # Area averaging divides white noise by the shrinking factor.
    noise = max(sigma, LEVEL_NOISE) * small_width / width

    gx, gy = _gradients(thumbnail)
    weight, energy, of_scene = _tile_means(np.stack([seen, (gx * gx + gy * gy) * seen, scene]))
    energy = energy / np.maximum(weight, 1e-6)
    snr = np.where(weight > 0.5, np.sqrt(energy) / noise, 0.0).astype(np.float32)
    unmasked = of_scene > 0.5
    usable = float((snr > min_snr)[unmasked].mean()) if unmasked.any() else 0.0
    level = float(thumbnail[scene > 0].mean()) if scene.any() else 0.0
    coarse = (COARSE_CELLS, max(round(size[1] * COARSE_CELLS / size[0]), 2))
    # The masked part of a picture does not change, so it changes no ratio to the running level.
    relief = float(_step_energies(_shrunk(thumbnail, coarse)).mean())
    sharpness = _step_energies(thumbnail) / max(relief, 1e-6)
    smooth = np.asarray(cv2.GaussianBlur(thumbnail, (0, 0), SMOOTHING_PX), dtype=np.float32)
    return Thumbnail(smooth, seen, snr, usable, level, sharpness)


def motion_widths(reference: Thumbnail, thumbnail: Thumbnail, share: float) -> float:
    """Displacement, in picture widths, that ``share`` of the textured tiles stay below.

    One Lucas-Kanade step for each tile. Infinite where the difference is no small motion, or where
    no tile has enough texture.
    """
    seen = reference.seen * thumbnail.seen
    old, new = _same_exposure(reference.grey, thumbnail.grey, seen)
    gx, gy = _gradients(0.5 * (old + new))
    d = (new - old) * seen
    gx, gy = gx * seen, gy * seen
    products = np.stack([gx * gx, gx * gy, gy * gy, gx * d, gy * d, d * d])
    xx, xy, yy, xd, yd, dd = _tile_means(products)
    textured = (np.minimum(reference.snr, thumbnail.snr) > MOTION_SNR) & (xx + yy > 0)
    if not textured.any():
        return float("inf")
    trace = (xx + yy)[textured]
    difference = np.sqrt(dd[textured] / trace)
    if float(np.quantile(difference, share)) > LINEAR_PX:
        return float("inf")
    # Along an edge nothing is measured: a small ridge leaves that component at zero.
    ridge = 1e-2 * trace
    xx, xy, yy = xx[textured] + ridge, xy[textured], yy[textured] + ridge
    xd, yd = xd[textured], yd[textured]
    size = np.hypot(yy * xd - xy * yd, xx * yd - xy * xd) / (xx * yy - xy * xy)
    width = int(thumbnail.grey.shape[1])
    return float(np.quantile(size, share)) / width


def _same_exposure(
    old: Float,  # [h, w]
    new: Float,  # [h, w]
    seen: Float,  # [h, w]
) -> tuple[Float, Float]:
    """``old`` with gain and offset of ``new``, by least squares, and ``new``."""
    count = max(float(seen.sum()), 1.0)
    mean_old, mean_new = float((old * seen).sum()) / count, float((new * seen).sum()) / count
    centred = (old - mean_old) * seen
    variance = float((centred * centred).sum())
    gain = float((centred * (new - mean_new)).sum()) / max(variance, 1e-6)
    gain = float(np.clip(gain, 1.0 / EXPOSURE_CHANGE, EXPOSURE_CHANGE))
    return (gain * (old - mean_old) + mean_new).astype(np.float32), new


def _shrunk(
    picture: Float,  # [H, W]
    size: tuple[int, int],  # width, height
) -> Float:
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _tile_means(
    pictures: Float,  # [..., H, W]
) -> Float:
    """[..., rows, columns] mean over each tile; several times as fast as ``_shrunk``, which has no
    vectors for sides that are no whole numbers of pixels."""
    columns, rows = TILES
    down, across = (
        _area_weights(pictures.shape[-2], rows),
        _area_weights(pictures.shape[-1], columns),
    )
    return np.asarray(down @ pictures @ across.T, dtype=np.float32)


@lru_cache(maxsize=8)
def _area_weights(length: int, parts: int) -> Float:
    """[parts, length] share of each pixel in the mean of each of ``parts`` equal parts."""
    edges = np.linspace(0.0, length, parts + 1)[:, None]
    pixels = np.arange(length)
    overlap = np.minimum(edges[1:], pixels + 1) - np.maximum(edges[:-1], pixels)
    weights = np.asarray(np.maximum(overlap, 0.0) * (parts / length), dtype=np.float32)
    weights.setflags(write=False)
    return weights


def _gradients(
    picture: Float,  # [h, w]
) -> tuple[Float, Float]:
    """Central differences along x and y; their noise has the picture's own sigma, over sqrt 2."""
    step = np.array([[-0.5, 0.0, 0.5]], np.float32)
    gx = cv2.filter2D(picture, cv2.CV_32F, step)
    gy = cv2.filter2D(picture, cv2.CV_32F, np.ascontiguousarray(step.T))
    return np.asarray(gx), np.asarray(gy)


def _step_energies(
    picture: Float,  # [h, w]
) -> Float:
    """[4] mean squared difference of neighbours: along x, along y and along both diagonals.

    Four, because motion blur takes the detail along the motion and leaves the rest.
    """
    steps = (
        picture[:, 1:] - picture[:, :-1],
        picture[1:] - picture[:-1],
        picture[1:, 1:] - picture[:-1, :-1],
        picture[1:, :-1] - picture[:-1, 1:],
    )
    return np.array([np.mean(step * step) for step in steps], np.float32)
