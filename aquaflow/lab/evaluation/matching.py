"""How well a prior finds pixels again: pictures against themselves, turned, shifted and relit.

A homography gives every pixel its true match, so that real pictures can be used, whose geometry
is unknown (notes/measurements.md#compact-prior has the figures of the prototypes).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Float, Mask, Prior

Picture: TypeAlias = npt.NDArray[np.uint8]
Matrix: TypeAlias = npt.NDArray[np.float64]
Matcher: TypeAlias = Callable[[Picture, Picture], tuple[Float, Mask]]
"""From two pictures [H, W, 3]: matches [H, W, 2] px of the first in the second, and which are
valid, [H, W]."""

WIDTH, HEIGHT = 320, 240
"""px of the pictures that are matched."""
MARGIN_X, MARGIN_Y = 40, 30
"""px of the picture beyond that: the second picture sees it where it turned or moved away."""
RIM_PX = 3.0
"""A true match this close to the second picture's rim does not count."""
WITHIN_PX = 2.0
"""Error up to which a match counts as right."""


@dataclass(frozen=True)
class Distortion:
    """How far apart two pictures are; each number is the most, drawn evenly from both signs."""

    name: str
    turn_deg: float
    shift_px: tuple[float, float]
    log_zoom: float
    perspective: float
    """1/px"""

    @classmethod
    def scale(cls, name: str, by: float) -> Distortion:
        """``by`` times the medium level."""
        return cls(name, 20.0 * by, (45.0 * by, 35.0 * by), 0.2 * by, 4e-4 * by)


LEVELS = (
    Distortion.scale("mild", 0.3),
    Distortion.scale("medium", 1.0),
    Distortion.scale("hard", 1.6),
)
"""Easy to hard; shares of the same largest motion."""


@dataclass(frozen=True)
class HomographyPair:
    """Two pictures and where each pixel of a truly is in b."""

    a: Picture
    b: Picture
    truth: Float
    """[H, W, 2] px"""
    inside: Mask
    """[H, W]: b's picture holds the true match."""


def homography_pair(
    picture: Picture,  # [h, w, 3] of any size
    level: Distortion,
    rng: np.random.Generator,
) -> HomographyPair:
    """``picture`` and a copy of it as another camera in another light would record it."""
    size = (WIDTH + 2 * MARGIN_X, HEIGHT + 2 * MARGIN_Y)
    large = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    a = np.asarray(large[MARGIN_Y:-MARGIN_Y, MARGIN_X:-MARGIN_X], np.uint8).copy()
    H = _homography(level, rng)
    from_large = np.array([[1.0, 0, -MARGIN_X], [0, 1.0, -MARGIN_Y], [0, 0, 1.0]])
    b = cv2.warpPerspective(large, H @ from_large, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    mapped = np.stack([u, v, np.ones_like(u)], -1) @ H.T
    # OpenCV puts pixel centres at whole numbers, this package at halves.
    truth = (mapped[..., :2] / mapped[..., 2:] + 0.5).astype(np.float32)
    far = np.array([WIDTH, HEIGHT]) - RIM_PX
    inside = np.asarray(((truth > RIM_PX) & (truth < far)).all(-1))
    return HomographyPair(a, relit(np.asarray(b, np.uint8), rng), truth, inside)


def relit(
    picture: Picture,  # [H, W, 3]
    rng: np.random.Generator,
) -> Picture:
    """Another white balance, gain, haze, gamma, noise of 5 grey levels, and a little blur."""
    gain = rng.uniform(0.6, 1.4, 3) * rng.uniform(0.7, 1.2)
    light = np.clip(picture / 255.0 * gain + rng.uniform(-0.05, 0.1, 3), 0.0, 1.0)
    grey = 255.0 * light ** rng.uniform(0.75, 1.3) + rng.normal(0.0, 5.0, picture.shape)
    noisy = np.clip(grey, 0, 255).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(noisy, (0, 0), rng.uniform(0.3, 1.0)), dtype=np.uint8)


def homography_recall(
    matcher: Matcher,
    pictures: Sequence[Picture],  # [H, W, 3] RGB each
    level: Distortion,
    pairs: int,
    seed: int = 0,
) -> dict[str, float]:
    """Means over ``pairs``: ``recall`` within 2 px of all pixels that have a match, ``kept`` of
    them by the matcher's own check, ``precision`` within 2 px of what it kept."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(pairs):
        pair = homography_pair(pictures[int(rng.integers(len(pictures)))], level, rng)
        matches, valid = matcher(pair.a, pair.b)
        right = np.linalg.norm(matches - pair.truth, axis=-1) < WITHIN_PX
        kept = valid & pair.inside
        rows.append(
            (
                right[pair.inside].mean(),
                kept.sum() / max(pair.inside.sum(), 1),
                right[kept].mean() if kept.any() else 0.0,
            )
        )
    means = np.mean(rows, axis=0)
    return {name: float(x) for name, x in zip(("recall", "kept", "precision"), means, strict=True)}


def matcher_of(prior: Prior) -> Matcher:
    """The prior's matches, nothing predicted."""
    camera = CameraModel(WIDTH, HEIGHT, 0.75 * WIDTH, 0.75 * WIDTH, WIDTH / 2, HEIGHT / 2)

    def match(a: Picture, b: Picture) -> tuple[Float, Mask]:
        found = prior.decode(prior.encode(a, camera), prior.encode(b, camera))
        return found.matches, found.valid

    return match


def _homography(level: Distortion, rng: np.random.Generator) -> Matrix:
    """[3, 3] about the picture's middle, from pixels of a to pixels of b."""
    turn = np.radians(rng.uniform(-1.0, 1.0) * level.turn_deg)
    zoom = np.exp(rng.uniform(-1.0, 1.0) * level.log_zoom)
    shift = rng.uniform(-1.0, 1.0, 2) * level.shift_px
    tilt = rng.uniform(-1.0, 1.0, 2) * level.perspective
    cosine, sine = zoom * np.cos(turn), zoom * np.sin(turn)
    moved = np.array([[cosine, -sine, shift[0]], [sine, cosine, shift[1]], [*tilt, 1.0]])
    centre = np.array([[1.0, 0, -WIDTH / 2], [0, 1.0, -HEIGHT / 2], [0, 0, 1.0]])
    return np.asarray(np.linalg.inv(centre) @ moved @ centre)
