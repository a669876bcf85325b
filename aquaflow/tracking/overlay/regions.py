"""From gradients that stay to the regions of an overlay: text blocks, crosshairs, logos."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.tracking.overlay.static_structure import NOISE, Float, StaticStructure

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
