"""The report as a PDF: the same values on A4 pages, by matplotlib's own writer."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.storage.atomic import atomic_write
from aquaflow.survey.report import sections
from aquaflow.survey.report.data import HeldOutExample, ReportData
from aquaflow.survey.report.figures import (
    GRID,
    STYLE,
    coverage_axes,
    level_axes,
    medium_axes,
    path_axes,
    profile_axes,
)
from aquaflow.survey.report.sections import MINIMUM_PATH, TILES

if TYPE_CHECKING:
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure, SubFigure

EXAMPLE_IN, PATH_IN, PLAN_IN, OVERVIEW_IN, PROFILE_IN, WATER_IN = 2.4, 3.2, 3.8, 3.4, 2.2, 2.8
"""Heights of the drawings."""


def write_pdf(path: Path, data: ReportData) -> int:
    """Write the report as a PDF, whole or not at all; how many pages it has.

    Raises:
        InputError: the file cannot be written.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_pdf import PdfPages

    buffer = io.BytesIO()
    title = f"{data.name}: AquaFlow dive report"
    known = {"Title": title, "Creator": "AquaFlow", "Producer": None, "CreationDate": None}
    with mpl.rc_context({**STYLE, "pdf.fonttype": 42}), PdfPages(buffer, metadata=known) as pdf:
        pages = Pages(pdf, title)
        for write in (_summary, _survey, _water, _examples, _words):
            write(pages, data)
        pages.close()
        count = int(pdf.get_pagecount())
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())
    return count


def _summary(pages: Pages, data: ReportData) -> None:
    """Name, numbers, and the path."""
    pages.title(data.name)
    if data.warnings:
        pages.heading("Look at this first")
        pages.items(data.warnings)
    pages.table([
        (label, form.format(data.metrics[key]))
        for key, form, label in TILES
        if isinstance(data.metrics.get(key), int | float)
    ])  # fmt: skip
    path = data.path
    if path is not None and np.isfinite(path.positions).all(axis=1).sum() >= MINIMUM_PATH:
        pages.heading("The path", PATH_IN)
        pages.drawing(PATH_IN, level_axes if path.up else path_axes, path)
    if data.measures is not None:
        pages.heading("Metres, gravity and north")
        pages.table(data.measures.rows)


def _survey(pages: Pages, data: ReportData) -> None:
    """Coverage, the map from above, and depth over time."""
    view = data.coverage
    if view is not None:
        pages.heading("What was seen", PLAN_IN + 0.5)
        pages.paragraph(sections.coverage_words(view))
        pages.drawing(PLAN_IN, coverage_axes, view)
        pages.table(sections.coverage_rows(view))
    if data.overview is not None:
        pages.heading("The map from above, without water", OVERVIEW_IN)
        pages.picture(_decode(data.overview), OVERVIEW_IN)
    if data.profile is not None:
        pages.heading("Depth and altitude", PROFILE_IN)
        pages.drawing(PROFILE_IN, profile_axes, data.profile)
    if data.reef:
        pages.heading("The ground in numbers, each with 1 sigma and its 95 % interval")
        pages.paragraph(f"Vertical: {data.vertical}.")
        pages.table([
            (row.label, row.value, f"({row.interval})" if row.interval else row.meaning)
            for row in data.reef
        ])  # fmt: skip


def _water(pages: Pages, data: ReportData) -> None:
    """Curves, then numbers."""
    if data.medium is None:
        return
    pages.heading("The water", WATER_IN)
    pages.drawing(WATER_IN, medium_axes, data.medium)
    rows = [("", *sections.RGB), *sections.water_rows(data.medium)]
    pages.table(rows)
    pages.paragraph(sections.visibility_words(data.medium) + sections.lamp_words(data.medium))


def _examples(pages: Pages, data: ReportData) -> None:
    """Held-out views."""
    if data.examples:
        pages.heading("Views that the map never saw", EXAMPLE_IN)
    for example in data.examples:
        pages.drawing(EXAMPLE_IN, _example_axes, example)


def _words(pages: Pages, data: ReportData) -> None:
    """What was left out, what to know, and the camera."""
    if data.left_out:
        pages.heading("What was left out, and why")
        pages.table([(row.reason, f"{row.kind}: {row.count:,}") for row in data.left_out])
    if data.notes:
        pages.heading("What to know")
        pages.items(data.notes)
    camera = data.camera
    pages.heading("The camera")
    pages.table([
        ("picture", f"{camera.width} x {camera.height} px"),
        ("focal length", f"{camera.focal_px:.1f} px, {camera.focal_source}"),
    ])  # fmt: skip


def _example_axes(figure: Figure, example: HeldOutExample) -> None:
    """The camera's picture, the map's, and that without water."""
    pictures: list[tuple[str, npt.NDArray[np.uint8]]] = [
        ("camera", example.real), ("rendered from the map", example.rendered),
    ]  # fmt: skip
    if example.restored is not None:
        pictures.append(("without the water", example.restored))
    panels = figure.subplots(1, len(pictures), squeeze=False)[0]
    for axes, (name, picture) in zip(panels, pictures, strict=True):
        axes.imshow(picture)
        axes.set_axis_off()
        axes.set_title(name, fontsize=8.0)
    figure.suptitle(example.caption, fontsize=9.0, x=0.02, ha="left")


def _decode(png: bytes) -> npt.NDArray[np.uint8]:
    """[H, W, 4] RGBA."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGBA"))


# --------------------------------------------------------------------------------------------------
# Pages of a PDF that fill from top to bottom: headings, paragraphs, tables, figures.

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
        """Heading of a section; it stays with so many inches of what follows."""
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
