"""Pages of a PDF that fill from top to bottom: headings, paragraphs, tables, figures."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow.survey.report.figures import GRID

if TYPE_CHECKING:
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure, SubFigure

WIDTH_IN, HEIGHT_IN = 8.27, 11.69
"""A4."""
MARGIN_IN = 0.75
"""On all sides."""
TEXT_PT, LINE_IN = 9.0, 0.18
"""Letters and lines of text."""
HEADING_IN = 0.45
"""A heading with the space around it."""
LETTERS = 100
"""Of a line of text across the page, on the average of English."""
PALE = "#d5e0e4"
"""Grid lines on paper; in the SVG they have a colour of the page's own."""


class Pages:
    """Begins a page, and another one whenever that is full."""

    def __init__(self, pdf: PdfPages, header: str) -> None:
        """``header``: a line at the top of every page."""
        self._pdf, self._header = pdf, header
        self._figure = self._begin_page()
        self._y = HEIGHT_IN - MARGIN_IN
        """Inches from the bottom up to which the page is free."""

    def title(self, text: str) -> None:
        """The name of the whole."""
        self._text(text, 20.0, 0.45, weight="bold", letters=45)

    def heading(self, text: str, keep_in: float = 1.0) -> None:
        """Of a section; it stays with so many inches of what follows."""
        self._room(keep_in + HEADING_IN)
        self._y -= 0.12
        self._text(text, 12.0, 0.28, weight="bold", letters=80)

    def paragraph(self, text: str) -> None:
        """Folded at the page's width."""
        self._text(text, TEXT_PT, LINE_IN)
        self._y -= 0.08

    def items(self, texts: Iterable[str]) -> None:
        """A list."""
        for text in texts:
            self._text(f"\u2022 {text}", TEXT_PT, LINE_IN)
        self._y -= 0.08

    def table(self, rows: Sequence[tuple[str, ...]]) -> None:
        """Rows of a name and its values; names and a single value are folded."""
        for name, *values in rows:
            columns = np.linspace(0.0, 1.0, 6)[2:][:: 1 if len(values) > 1 else 4]
            width = LETTERS // 3 if len(values) > 1 else 3 * LETTERS // 5
            cells = [textwrap.wrap(name, 2 * LETTERS // 5 - 2) or [""]]
            cells += [textwrap.wrap(value, width) or [""] for value in values]
            for line in range(max(map(len, cells))):
                self._room(LINE_IN)
                for at, cell in zip((0.0, *columns), cells, strict=False):
                    if line < len(cell):
                        self._put(cell[line], at, TEXT_PT)
                self._y -= LINE_IN
        self._y -= 0.08

    def drawing(self, height_in: float, draw: Callable[[Any, Any], None], data: Any) -> None:
        """What ``draw`` draws of ``data`` into a figure as wide as the page."""
        part = self._part(height_in)
        draw(part, data)
        for artist in part.findobj():
            _pale(artist)

    def picture(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB or [H, W, 4] RGBA
        height_in: float,
    ) -> None:
        """A picture in the middle of the page."""
        axes = self._part(height_in).subplots()
        axes.imshow(image)
        axes.set_axis_off()

    def close(self) -> None:
        """The page is done."""
        self._pdf.savefig(self._figure)  # type: ignore[no-untyped-call]

    def _begin_page(self) -> Figure:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        top = 1.0 - 0.45 / HEIGHT_IN
        figure.text(
            MARGIN_IN / WIDTH_IN, top, self._header, fontsize=8.0, color="#56707a", parse_math=False
        )
        return figure

    def _room(self, inches: float) -> None:
        """Another page where this one has less room."""
        if self._y - inches < MARGIN_IN:
            self.close()
            self._figure, self._y = self._begin_page(), HEIGHT_IN - MARGIN_IN

    def _text(
        self, text: str, size_pt: float, line_in: float, letters: int = LETTERS, **style: Any
    ) -> None:
        for line in textwrap.wrap(text, letters) or [""]:
            self._room(line_in)
            self._put(line, 0.0, size_pt, **style)
            self._y -= line_in

    def _put(self, text: str, at: float, size_pt: float, **style: Any) -> None:
        """At a share of the page's width, below what is there."""
        x = (MARGIN_IN + at * (WIDTH_IN - 2 * MARGIN_IN)) / WIDTH_IN
        y = self._y / HEIGHT_IN
        self._figure.text(x, y, text, fontsize=size_pt, va="top", parse_math=False, **style)

    def _part(self, height_in: float) -> SubFigure:
        """A part of the page, as wide as it."""
        self._room(height_in)
        free = HEIGHT_IN - self._y
        rest = self._y - height_in
        parts: Any = self._figure.subfigures(
            3, 3, height_ratios=[free, height_in, rest], wspace=0.0, hspace=0.0,
            width_ratios=[MARGIN_IN, WIDTH_IN - 2 * MARGIN_IN, MARGIN_IN],
        )  # fmt: skip
        self._y -= height_in
        part: SubFigure = parts[1, 1]
        return part


def _pale(artist: Any) -> None:
    """On paper, grid lines and shaded spans are grey."""
    from matplotlib.colors import to_hex

    for name in ("color", "facecolor", "edgecolor"):
        read = getattr(artist, f"get_{name}", None)
        if read is None:
            continue
        try:
            colour = to_hex(read())
        except (TypeError, ValueError):  # of many colours, or of none
            continue
        if colour == GRID:
            getattr(artist, f"set_{name}")(PALE)
