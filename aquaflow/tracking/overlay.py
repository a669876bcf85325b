"""Finds what a recorder burned into the pictures, by its staying where it is while the scene moves.

A vehicle that stands still shows nothing about overlays: only pictures in which most of the scene
has changed are looked at. What was found is tested again with every one of them, so a part of the
scene that stood still for long is given back as soon as the vehicle moves on. Pictures are looked
at no wider than ``WIDTH_PX``.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.types import Frame

THUMBNAIL_PX = 160
"""Width at which the scene is seen to move; a shift of 2 % of the width shows."""
TILES = (12, 9)
"""Columns and rows of tiles, each of which moved or did not."""
TEXTURED = 1.5
"""Grey levels per pixel of the thumbnail: a tile with less has nothing that could move."""
SAME = 0.5
"""Correlation of a tile's gradients from which it counts as not moved."""
CHANGED_SHARE = 0.6
"""Textured tiles that must have moved since the last sample."""
FIRST_SAMPLES = 3.5
"""Effective samples before anything is judged."""
MOST_SHARE = 0.4
"""Of the picture: more is no overlay."""


class OverlayFinder:
    """Masks overlays in the frames of one stream, in their order; deterministic."""

    def __init__(self) -> None:
        self.share = 0.0
        """Part of the picture that was masked last; 0 if no overlay was ever found."""
        self._static: StaticStructure | None = None
        self._hidden: Mask = np.zeros((0, 0), bool)
        self._shown: Mask | None = None
        self._last: tuple[Float, Float] | None = None

    @property
    def shown(self) -> Mask | None:
        """[H, W] what is no overlay, as far as is known by now; None: no overlay is known."""
        return self._shown

    def mask(self, frame: Frame) -> Frame:
        """The frame with its mask limited to what is no overlay."""
        if self._has_moved(frame.image):
            self._sample(frame)
        if self._shown is None:
            return frame
        shown = self._shown if frame.mask is None else self._shown & frame.mask
        return replace(frame, mask=shown)

    def _has_moved(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3]
    ) -> bool:
        """True if most of what is textured changed since the last sample."""
        height, width = image.shape[:2]
        size = (THUMBNAIL_PX, max(round(height * THUMBNAIL_PX / width), TILES[1]))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        new = gradients(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32))
        old, moved = self._last, True
        if old is not None:
            both, before, after = (
                cv2.resize(a[0] * b[0] + a[1] * b[1], TILES, interpolation=cv2.INTER_AREA)
                for a, b in ((old, new), (old, old), (new, new))
            )
            textured = np.minimum(before, after) > TEXTURED**2
            if self._hidden.any():
                hidden = cv2.resize(
                    self._hidden.astype(np.float32), TILES, interpolation=cv2.INTER_AREA
                )
                textured &= hidden < 0.25
            same = both[textured] > SAME * np.sqrt(before * after)[textured]
            moved = bool(same.size and 1.0 - same.mean() >= CHANGED_SHARE)
        if moved:
            self._last = new
        return moved

    def _sample(self, frame: Frame) -> None:
        height, width = frame.image.shape[:2]
        grey = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        if width > WIDTH_PX:
            size = (WIDTH_PX, round(height * WIDTH_PX / width))
            grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))
        if self._static is None:
            self._static = StaticStructure((grey.shape[0], grey.shape[1]))
            self._hidden = np.zeros(grey.shape, bool)
        self._static.add(grey.astype(np.float32))
        if self._static.samples < FIRST_SAMPLES:
            return
        hidden = overlay_regions(self._static, self._hidden)
        if hidden.mean() > MOST_SHARE:
            hidden = np.zeros_like(hidden)
        self._hidden, share = hidden, float(hidden.mean())
        self.share = share or self.share
        full = cv2.resize(hidden.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        self._shown = np.asarray(full == 0) if share > 0.0 else None


# --------------------------------------------------------------------------------------------------
# From gradients that stay to the regions of an overlay: text blocks, crosshairs, logos.

Mask = npt.NDArray[np.bool_]
Box = tuple[int, int, int, int]

STRONG = 6.0
"""Grey levels per pixel of a gradient that counts: a semi-transparent logo has more."""
KEPT = 0.75
"""Of the coherence that is asked for, what suffices where a mask is already."""
WIDTH_PX = 480
"""Of the pictures that the sizes below are for; they grow and shrink with it."""
BETWEEN_CHARACTERS_PX = (17, 7)
"""Along and across a text: what is nearer belongs together."""
LEAST_SEEDS = 12
"""Pixels of a region: a laser dot has more, chance fewer."""
RING_PX = 19
"""Surroundings of a region that have to move."""
MOVING = 1.5
"""Grey levels per pixel: changing gradients by which the surroundings are seen to move."""
MOVED_SHARE = 0.6
"""Of the surroundings' power, the changing part: less, and the scene itself may stand there."""
UNSEEN_SAMPLES = 14.0
"""Samples after which what stays is masked though nothing can be seen to move around it."""
TEXT_HEIGHT_PX = (6, 40)
"""Of a line of text; its changing digits are looked for at its ends."""
TEXT_WIDTH = 1.5
"""Width of a line of text over its height: a clock without its changing digits is longer."""
TEXT_CONTRAST = 20.0
"""Grey levels per pixel: text is made to be read on any picture."""
CHANGING_LENGTH = 3.0
"""Line heights that changing digits may take at either end of a line."""
GAP_LENGTH = 0.6
"""Line heights of a space between characters."""
FILLED_SHARE = 0.1
"""Of the picture: a smaller frame is masked with what it encloses."""
STROKE_SHARE = 0.45
"""Contrast of a changing digit over that of the text beside it, in every sample."""
STROKE_ROWS = 0.6
"""Share of a line's height in which a digit has strokes."""
BOTH_WAYS = 0.2
"""Least over largest power of a region's gradients along two axes: letters, boxes and crosses have
both. An edge of the scene along which the vehicle moves stays, too, and has one."""
MARGIN_PX = 3
"""Around a region: what compression and flow's patches smear of it."""


def overlay_regions(
    static: StaticStructure,
    before: Mask,  # [H, W] the overlay as found so far
) -> Mask:
    """[H, W] True where an overlay is."""
    coherence, mean = static.coherence, static.mean
    strength = np.hypot(*mean)
    least = static.least_coherence
    seeds = (strength > STRONG) & (coherence > np.where(before, KEPT * least, least))
    size = before.shape[1] / WIDTH_PX
    across, down = (max(1, round(each * size)) for each in BETWEEN_CHARACTERS_PX)
    closed = cv2.morphologyEx(
        seeds.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((down, across), np.uint8)
    )
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed)
    found = np.zeros_like(before)
    candidates = cv2.dilate(closed, np.ones((5, 5), np.uint8)) > 0
    for label in range(1, count):
        x, y, w, h = (int(value) for value in stats[label, :4])
        own = labels[y : y + h, x : x + w] == label
        inner = own & seeds[y : y + h, x : x + w]
        mx, my = (each[y : y + h, x : x + w][inner] for each in mean)
        if len(mx) < LEAST_SEEDS or not _goes_both_ways(mx, my):
            continue
        if not _stands_out(static, strength, candidates, (x, y, w, h), round(RING_PX * size)):
            continue
        found[y : y + h, x : x + w] |= own
        contrast = float(np.median(np.hypot(mx, my)))
        if _is_text(w, h, contrast, size):
            left, right = _line_ends(static.persistent, (x, y, w, h), STROKE_SHARE * contrast)
            found[y : y + h, left:x] = found[y : y + h, x + w : right] = True
    side = 2 * max(1, round(MARGIN_PX * size)) + 1
    grown = cv2.dilate(found.astype(np.uint8), np.ones((side, side), np.uint8))
    return _fill(np.asarray(grown, dtype=np.uint8))


def _fill(
    found: npt.NDArray[np.uint8],  # [H, W]
) -> Mask:
    """With what small frames enclose."""
    outlines, _ = cv2.findContours(found, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    small = [each for each in outlines if cv2.contourArea(each) < FILLED_SHARE * found.size]
    return np.asarray(cv2.drawContours(found, small, -1, 1, cv2.FILLED) > 0)


def _is_text(w: int, h: int, contrast: float, size: float) -> bool:
    low, high = (size * each for each in TEXT_HEIGHT_PX)
    return low <= h <= high and w > TEXT_WIDTH * h and contrast > TEXT_CONTRAST


def _goes_both_ways(
    gx: Float,  # [M]
    gy: Float,  # [M]
) -> bool:
    xx, yy, xy = float((gx * gx).sum()), float((gy * gy).sum()), float((gx * gy).sum())
    apart = float(np.hypot(xx - yy, 2.0 * xy))
    return xx + yy - apart > BOTH_WAYS * (xx + yy + apart)


def _stands_out(
    static: StaticStructure,
    strength: Float,  # [H, W]
    candidates: Mask,  # [H, W] all that may be an overlay
    box: Box,
    ring: int,
) -> bool:
    """True if the scene moves around the region, or if nothing of it is seen there for long."""
    x, y, w, h = box
    rows = slice(max(0, y - ring), y + h + ring)
    columns = slice(max(0, x - ring), x + w + ring)
    around = ~candidates[rows, columns]
    if not around.any():
        return static.samples >= UNSEEN_SAMPLES
    power = float(static.power[rows, columns][around].mean())
    staying = float((strength[rows, columns][around] ** 2).mean())
    if power - staying > MOVING**2:
        # What little stays of n random gradients is 1 / n of their power.
        return power - staying > MOVED_SHARE * (1.0 - 1.0 / static.samples) * power
    return static.samples >= UNSEEN_SAMPLES and staying < NOISE**2


def _line_ends(
    persistent: Float,  # [H, W]
    box: Box,
    contrast: float,
) -> tuple[int, int]:
    """Columns at which a line of text ends whose last or first characters change."""
    x, y, w, h = box
    strokes = (persistent[y : y + h] > contrast).mean(axis=0) > STROKE_ROWS
    left = _reach(strokes[:x][::-1], h)
    right = _reach(strokes[x + w :], h)
    return x - left, x + w + right


def _reach(
    strokes: Mask,  # [N] columns, outwards from the line's end
    h: int,
) -> int:
    """How many of them belong to the line."""
    reach = 0
    for k in np.flatnonzero(strokes[: round(CHANGING_LENGTH * h)]):
        if k - reach > GAP_LENGTH * h:
            break
        reach = int(k) + 1
    return reach


# --------------------------------------------------------------------------------------------------
# Running statistics of a picture's gradients: which of them stay while the scene moves.

Float = npt.NDArray[np.float32]

MEMORY = 20.0
"""Samples that the statistics remember: a display that is switched off is forgotten after them."""
NOISE = 3.0
"""Grey levels per pixel: gradients of sensor noise and compression, which stay by chance."""
CHANCE = 1e-4
"""Probability with which a gradient of the moving scene may pass for one that stays."""
LEAST_COHERENCE = 0.6
"""However many samples there are: a semi-transparent logo keeps more."""
CHARACTER_PX = 9
"""Width of a digit at 480 px: in a square of this size a text has a stroke in every picture."""


class StaticStructure:
    """Moments of the gradient at every pixel, over pictures of different parts of the scene.

    The coherent power |mean g|^2 / mean |g|^2 is 1 for a gradient that stays and 1 / n on average
    for n random ones; one strong edge that passed once does not raise it.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        """``shape``: rows, columns."""
        self._gx: Float = np.zeros(shape, np.float32)
        self._gy: Float = np.zeros(shape, np.float32)
        self._power: Float = np.zeros(shape, np.float32)
        self._weight = self._squares = 0.0
        self.persistent: Float = np.full(shape, np.inf, np.float32)
        """[H, W] least contrast of any sample in a character's surroundings."""

    def add(
        self,
        grey: Float,  # [H, W]
    ) -> None:
        """One sample; earlier ones fade."""
        gx, gy = gradients(grey)
        power = gx * gx + gy * gy
        keep = 1.0 - 1.0 / MEMORY
        totals, values = (self._gx, self._gy, self._power), (gx, gy, power)
        self._gx, self._gy, self._power = (
            np.asarray(cv2.addWeighted(total, keep, value, 1.0, 0.0), dtype=np.float32)
            for total, value in zip(totals, values, strict=True)
        )
        self._weight = keep * self._weight + 1.0
        self._squares = keep * keep * self._squares + 1.0
        near = cv2.dilate(np.sqrt(power), np.ones((CHARACTER_PX, CHARACTER_PX), np.uint8))
        # It fades upwards as the sums do, so that one picture of the past is not for ever.
        self.persistent = np.minimum(self.persistent * np.float32(1.0 / keep), near)

    @property
    def samples(self) -> float:
        """Effective number of samples."""
        return self._weight**2 / max(self._squares, 1e-12)

    @property
    def mean(self) -> tuple[Float, Float]:
        """[H, W] each, mean gradient along x and y, grey levels per pixel."""
        scale = np.float32(1.0 / self._weight)
        return self._gx * scale, self._gy * scale

    @property
    def power(self) -> Float:
        """[H, W] mean squared gradient."""
        return np.asarray(self._power / self._weight, np.float32)

    @property
    def coherence(self) -> Float:
        """[H, W] coherent share of the power, 0 to 1."""
        mx, my = self.mean
        return np.asarray((mx * mx + my * my) / (self.power + NOISE**2), np.float32)

    @property
    def least_coherence(self) -> float:
        """What a random gradient exceeds with the probability ``CHANCE``.

        Of n independent complex normal gradients the coherent share exceeds t with the probability
        (1 - t)^(n - 1).
        """
        by_chance = 1.0 - CHANCE ** (1.0 / max(self.samples - 1.0, 1e-3))
        return max(LEAST_COHERENCE, float(by_chance))


def gradients(
    grey: Float,  # [H, W]
) -> tuple[Float, Float]:
    """Along x and y, per pixel."""
    gx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.125)
    gy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.125)
    return np.asarray(gx), np.asarray(gy)
