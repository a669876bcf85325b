"""The plan view as a picture: coloured cells, path, lines, the next line, legend and scale."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from aquaflow.survey.coverage.classes import COLOURS, WORDS, CoverageClass
from aquaflow.survey.coverage.page_view import PageView

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

Array = npt.NDArray[np.float64]
Rgb = npt.NDArray[np.uint8]

WIDTH, HEIGHT = 640, 480
"""Pixels of the whole picture: as a topside shows it beside the video."""
MARGIN, FOOT = 16, 58
"""Pixels around the plan, and below it for legend and scale bar."""
PAPER, INK, SOFT = (250, 251, 251), (20, 37, 43), (110, 125, 131)
PATH, NEXT = (20, 37, 43), (226, 62, 160)
"""Colours of the picture; those of the cells are COLOURS."""
SMALLEST = 0.5
"""Units across the plan at least."""
DOWNWARDS = np.array([1.0, -1.0])
"""Up on the page is down in pixels."""
TEXT_PX = 13
"""Height of the letters."""


@dataclass(frozen=True)
class _PageTransform:
    """From the page to pixels."""

    scale: float
    middle: Array
    """[2] of the page, shown at ``centre``."""
    centre: Array
    """[2] px"""

    def px(self, places: Array) -> Array:  # [..., 2] page
        return np.asarray(self.centre + (places - self.middle) * self.scale * DOWNWARDS)

    def page(self, px: Array) -> Array:  # [..., 2]
        return np.asarray(self.middle + (px - self.centre) / self.scale * DOWNWARDS)


def coverage_png(view: PageView, hints: str = "") -> bytes:
    """A PNG file of ``view``, WIDTH x HEIGHT, with a line of ``hints`` on top."""
    from PIL import Image, ImageDraw

    fit = _fit(view)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    cells = view.classes_at(fit.page(np.dstack([columns, rows]) + 0.5))
    pixels = _palette()[cells]
    pixels[HEIGHT - FOOT :] = PAPER
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    _path(draw, view, fit)
    _foot(draw, view, fit)
    if hints:
        draw.text((MARGIN, 6), hints, fill=NEXT, font_size=TEXT_PX + 2)
    return _png(image)


def cells_png(view: PageView) -> bytes:
    """A PNG file with a pixel for each cell of the plan, transparent where nothing was seen; its
    top row is the plan's last."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(view.plan.classes[::-1]), mode="P")
    image.putpalette(_palette().ravel().tolist())
    return _png(image, transparency=int(CoverageClass.NOT))


def cells_affine(view: PageView) -> Array:
    """[2, 3] from pixels (right, down, from the corner) of :func:`cells_png` to the page."""
    plan, rows = view.plan, view.plan.classes.shape[0]
    to_grid = np.array([
        [plan.cell, 0.0, plan.corner[0]],
        [0.0, -plan.cell, plan.corner[1] + rows * plan.cell],
        [0.0, 0.0, 1.0],
    ])  # fmt: skip
    return np.asarray(view.to_page @ to_grid)


def _palette() -> Rgb:
    """[4, 3] by class."""
    return np.array([COLOURS.get(seen, PAPER) for seen in CoverageClass], np.uint8)


def _fit(view: PageView) -> _PageTransform:
    rows, columns = view.plan.classes.shape
    corners = np.array([[0, 0, 1], [columns, 0, 1], [0, rows, 1], [columns, rows, 1]])
    places = [corners @ cells_affine(view).T, view.path]
    if view.state.suggestion is not None:
        places.append(np.array([view.state.suggestion.start, view.state.suggestion.end]))
    every = np.concatenate(places)
    low, high = every.min(axis=0), every.max(axis=0)
    room = np.array([WIDTH - 2 * MARGIN, HEIGHT - FOOT - 2 * MARGIN])
    scale = float((room / np.maximum(high - low, SMALLEST)).min())
    return _PageTransform(scale, 0.5 * (low + high), np.array([0.5 * WIDTH, 0.5 * (HEIGHT - FOOT)]))


def _path(draw: ImageDraw, view: PageView, fit: _PageTransform) -> None:
    points = [tuple(point) for point in fit.px(view.path).tolist()]
    if len(points) > 1:
        draw.line(points, fill=PATH, width=2)
    for line in view.state.lines:
        ends = fit.px(np.array([line.start, line.end])).tolist()
        draw.line([tuple(end) for end in ends], fill=PATH, width=3)
    x, y = points[-1]
    draw.ellipse([x - 6, y - 6, x + 6, y + 6], fill=(249, 115, 22), outline=PAPER, width=2)
    if view.state.suggestion is None:
        return
    start, end = (fit.px(each) for each in (view.state.suggestion.start, view.state.suggestion.end))
    length = float(np.linalg.norm(end - start))
    for at in np.arange(0.0, length, 14.0):  # dashes of 8 px
        dash = [start + (end - start) * min(s, length) / length for s in (at, at + 8.0)]
        draw.line([tuple(point.tolist()) for point in dash], fill=NEXT, width=3)
    x, y = start.tolist()
    draw.ellipse([x - 4, y - 4, x + 4, y + 4], fill=NEXT)


def _foot(draw: ImageDraw, view: PageView, fit: _PageTransform) -> None:
    """Legend with areas, or shares where there are none, and a scale bar."""
    x, y = float(MARGIN), HEIGHT - FOOT + 8
    areas, shares = view.areas, view.shares
    for seen in (CoverageClass.WELL, CoverageClass.SPARSE, CoverageClass.TOO_FAR):
        name = seen.name.lower()
        size = f"{100.0 * shares[name]:.0f} %" if areas is None else f"{areas[name]:.3g} sq m"
        text = f"{WORDS[seen]}: {size}"
        draw.rectangle([x, y + 2, x + 11, y + 13], fill=COLOURS[seen])
        draw.text((x + 16, y), text, fill=INK, font_size=TEXT_PX)
        x += 34 + draw.textlength(text, font_size=TEXT_PX)
    draw.text((MARGIN, y + 22), in_words(view), fill=SOFT, font_size=TEXT_PX)
    step = _round(80.0 / fit.scale)
    x, y = WIDTH - MARGIN - step * fit.scale, HEIGHT - 12
    draw.line([x, y - 5, x, y, WIDTH - MARGIN, y, WIDTH - MARGIN, y - 5], fill=INK, width=2)
    text = f"{step:g} {view.unit}"
    draw.text((WIDTH - MARGIN, y - 6), text, fill=INK, font_size=TEXT_PX, anchor="rs")


def in_words(view: PageView) -> str:
    """Overlap and what the next line would bring, in one line."""
    state, parts = view.state, [f"seen {view.seen}, up: {view.up}"]
    if state.overlap is not None:
        said = f"overlap {100 * state.overlap:.0f} %"
        gap = f"gap of {-state.overlap * state.swath:.2g} {view.unit}"
        parts.append(said if state.overlap >= 0.0 else gap)
    if state.suggestion is not None:
        parts.append(f"next line (dashed): {100 * state.suggestion.gain:.0f} % new")
    return "; ".join(parts)


def _round(length: float) -> float:
    """The largest of 1, 2, 5, 10, ... up to ``length``."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * 1.001))


def _png(image: object, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG", **options)  # type: ignore[attr-defined]
    return buffer.getvalue()
