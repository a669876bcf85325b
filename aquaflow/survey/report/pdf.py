"""The report as a PDF: the same values on A4 pages, by matplotlib's own writer."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
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
    fixes_axes,
    fold,
    level_axes,
    medium_axes,
    path_axes,
    profile_axes,
    text_width_in,
)
from aquaflow.survey.report.measures import FIX_COLUMNS, fix_cells, fix_words
from aquaflow.survey.report.sections import MINIMUM_PATH, TILES

if TYPE_CHECKING:
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure, SubFigure

PATH_IN, PLAN_IN, OVERVIEW_IN, PROFILE_IN, WATER_IN = 3.2, 3.8, 3.4, 2.2, 2.8
"""Heights of the drawings; that of the map from above at most."""
GAP_IN, NAME_IN = 0.1, 0.25
"""Between the pictures of a view, and above each for its name."""


def write_pdf(path: Path, data: ReportData) -> int:
    """Write the report as a PDF, whole or not at all; how many pages it has.

    Raises:
        InputError: the file cannot be written.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_pdf import PdfPages

    buffer = io.BytesIO()
    known = {"Title": _title(data), "Creator": "AquaFlow", "Producer": None, "CreationDate": None}
    with mpl.rc_context({**STYLE, "pdf.fonttype": 42}), PdfPages(buffer, metadata=known) as pdf:
        write_pages(pdf, data)
        count = int(pdf.get_pagecount())
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())
    return count


def write_pages(pdf: PdfPages, data: ReportData) -> None:
    """Write the report's pages into an open PDF."""
    pages = Pages(pdf, _title(data))
    for write in (_summary, _survey, _water, _examples, _words):
        write(pages, data)
    pages.close()


def _title(data: ReportData) -> str:
    return f"{data.name}: AquaFlow dive report"


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
        pages.heading("The path")
        pages.drawing(PATH_IN, level_axes if path.up else path_axes, path)
    if data.measures is not None:
        pages.heading("Metres, gravity and north")
        pages.table(data.measures.rows)


def _survey(pages: Pages, data: ReportData) -> None:
    """Coverage, the map from above, depth over time, and position fixes."""
    view = data.coverage
    if view is not None:
        pages.heading("What was seen", sections.coverage_words(view))
        pages.drawing(PLAN_IN, coverage_axes, view)
        pages.table(sections.coverage_rows(view))
    if data.overview is not None:
        pages.heading("The map from above, without water")
        pages.picture(_decode(data.overview), OVERVIEW_IN)
    if data.profile is not None:
        pages.heading("Depth and altitude")
        pages.drawing(PROFILE_IN, profile_axes, data.profile)
    if data.fixes:
        pages.heading("Position fixes", fix_words(data))
        pages.drawing(PLAN_IN, fixes_axes, data.fixes)
        pages.table([tuple(name for name, _ in FIX_COLUMNS), *fix_cells(data.fixes)])
    if data.reef:
        said = f"Each with 1 sigma and its 95 % interval. Vertical: {data.vertical}."
        pages.heading("The ground in numbers", said)
        pages.table([
            (row.label, row.value, f"({row.interval})" if row.interval else row.meaning)
            for row in data.reef
        ])  # fmt: skip


def _water(pages: Pages, data: ReportData) -> None:
    """Curves, then numbers."""
    if data.medium is None:
        return
    pages.heading("The water")
    pages.drawing(WATER_IN, medium_axes, data.medium)
    pages.table([("", *sections.RGB), *sections.water_rows(data.medium)])
    pages.paragraph(sections.visibility_words(data.medium) + sections.lamp_words(data.medium))


def _examples(pages: Pages, data: ReportData) -> None:
    """Held-out views."""
    if data.examples:
        pages.heading("Views that the map never saw")
    for example in data.examples:
        pages.heading(example.caption, size_pt=TEXT_PT)
        pages.drawing(_example_height_in(example), _example_axes, example)


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


def _example_pictures(example: HeldOutExample) -> list[tuple[str, npt.NDArray[np.uint8]]]:
    """The camera's picture, the map's, and that without water, with their names."""
    pictures = [("camera", example.real), ("rendered from the map", example.rendered)]
    if example.restored is not None:
        pictures.append(("without the water", example.restored))
    return pictures


def _example_height_in(example: HeldOutExample) -> float:
    """Of the pictures side by side, as wide as the page, with their names."""
    pictures = _example_pictures(example)
    each_in = (TEXT_IN - GAP_IN * (len(pictures) - 1)) / len(pictures)
    shapes = [each.shape for _, each in pictures]
    return NAME_IN + each_in * float(max(rows / columns for rows, columns, _ in shapes))


def _example_axes(figure: Figure, example: HeldOutExample) -> None:
    pictures = _example_pictures(example)
    panels = figure.subplots(1, len(pictures), squeeze=False)[0]
    for axes, (name, picture) in zip(panels, pictures, strict=True):
        axes.imshow(picture)
        axes.set_axis_off()
        axes.set_title(name, fontsize=8.0)


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
TEXT_IN = WIDTH_IN - 2 * MARGIN_IN
"""Width of what a page holds."""
HEADER_PT, TEXT_PT, HEADING_PT, TITLE_PT = 8.0, 9.0, 12.0, 20.0
"""Letters."""
LINE = 1.45
"""Height of a line over that of its letters."""
SPACE_IN = 0.08
"""Below a block."""
COLUMN_GAP_IN = 0.2
"""Between the columns of a table."""
WHOLE_TABLE_IN = 3.0
"""Height up to which a table stays on one page."""
NAMES_SHARE = 0.4
"""Of the page's width: what the first column of a table takes where there is room, so that tables
that follow each other are in line."""
PALE = "#d5e0e4"
"""Grid lines on paper; in the SVG they have a colour of the page's own."""


@dataclass(frozen=True)
class _Line:
    """Texts at one height."""

    texts: Sequence[tuple[float, str]]
    """Each after its distance from the left margin, inches."""
    size_pt: float = TEXT_PT
    weight: str = "normal"

    @property
    def height_in(self) -> float:
        """With the space to the next line."""
        return self.size_pt * LINE / 72.0


class Pages:
    """Begins a page, and another one whenever what comes has no room on it.

    Everything is measured before it is set: what is too wide is folded, a short table and every row
    of a long one stay whole, and a heading stays with the first of what follows.
    """

    def __init__(self, pdf: PdfPages, header: str) -> None:
        """``header``: a line at the top of every page."""
        self._pdf, self._header = pdf, fold(header, TEXT_IN, HEADER_PT)[0]
        self._figure = self._begin_page()
        self._y = HEIGHT_IN - MARGIN_IN
        """Inches from the bottom up to which the page is free."""
        self._headings: list[_Line] = []
        """That wait for what they are about."""

    def title(self, text: str) -> None:
        """The name of the whole."""
        self._set(_lines(text, TITLE_PT, "bold"))

    def heading(self, text: str, said: str = "", size_pt: float = HEADING_PT) -> None:
        """Heading of a section, with a sentence about it."""
        self._headings.append(_Line([], HEADING_PT))
        self._headings += _lines(text, size_pt, "bold")
        if said:
            self._headings += [*_lines(said), _Line([], SPACE_IN * 72.0 / LINE)]

    def paragraph(self, text: str) -> None:
        """Folded at the page's width."""
        self.items([text], mark="")

    def items(self, texts: Iterable[str], mark: str = "\u2022 ") -> None:
        """A list."""
        for text in texts:
            self._set(_lines(mark + text))
        self._y -= SPACE_IN

    def table(self, rows: Sequence[tuple[str, ...]]) -> None:
        """Rows of a name and its values, in columns as wide as their texts need and the page
        allows."""
        if not rows:
            return
        widths = _column_widths(rows)
        starts = [sum(widths[:column]) + COLUMN_GAP_IN * column for column in range(len(widths))]
        blocks = []
        for row in rows:
            cells = [fold(text, width, TEXT_PT) for text, width in zip(row, widths, strict=False)]
            blocks.append([
                _Line([(start, text) for start, text in zip(starts, line, strict=False) if text])
                for line in zip_longest(*cells, fillvalue="")
            ])  # fmt: skip
        whole = [line for block in blocks for line in block]
        if sum(line.height_in for line in whole) <= WHOLE_TABLE_IN:
            blocks = [whole]
        for block in blocks:
            self._set(block)
        self._y -= SPACE_IN

    def drawing(self, height_in: float, draw: Callable[[Any, Any], None], data: Any) -> None:
        """What ``draw`` draws of ``data`` into a figure as wide as the page."""
        part = self._part(height_in)
        draw(part, data)
        for artist in part.findobj():
            _pale(artist)

    def picture(
        self,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB or [H, W, 4] RGBA
        most_in: float,
    ) -> None:
        """A picture in the middle of the page, no higher than ``most_in``."""
        axes = self._part(min(most_in, TEXT_IN * image.shape[0] / image.shape[1])).subplots()
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
            MARGIN_IN / WIDTH_IN, top, self._header, fontsize=HEADER_PT, color="#56707a",
            parse_math=False,
        )  # fmt: skip
        return figure

    def _room(self, inches: float) -> None:
        """Another page where this one has less room; then what waits is set."""
        waits, self._headings = self._headings, []
        if self._y - inches - sum(line.height_in for line in waits) < MARGIN_IN:
            self._turn()
        for line in waits:
            self._put(line)

    def _turn(self) -> None:
        self.close()
        self._figure, self._y = self._begin_page(), HEIGHT_IN - MARGIN_IN

    def _set(self, block: Sequence[_Line]) -> None:
        """Lines that stay together, unless they fill more than a page."""
        self._room(sum(line.height_in for line in block))
        for line in block:
            self._put(line)

    def _put(self, line: _Line) -> None:
        if self._y - line.height_in < MARGIN_IN:
            self._turn()
        for x_in, text in line.texts:
            self._figure.text(
                (MARGIN_IN + x_in) / WIDTH_IN, self._y / HEIGHT_IN, text, fontsize=line.size_pt,
                weight=line.weight, va="top", parse_math=False,
            )  # fmt: skip
        self._y -= line.height_in

    def _part(self, height_in: float) -> SubFigure:
        """A part of the page, as wide as it."""
        self._room(height_in)
        free = HEIGHT_IN - self._y
        rest = self._y - height_in
        parts: Any = self._figure.subfigures(
            3, 3, height_ratios=[free, height_in, rest], wspace=0.0, hspace=0.0,
            width_ratios=[MARGIN_IN, TEXT_IN, MARGIN_IN],
        )  # fmt: skip
        self._y -= height_in + SPACE_IN
        part: SubFigure = parts[1, 1]
        return part


def _lines(text: str, size_pt: float = TEXT_PT, weight: str = "normal") -> list[_Line]:
    """``text`` folded at the page's width."""
    return [_Line([(0.0, line)], size_pt, weight) for line in fold(text, TEXT_IN, size_pt, weight)]


def _column_widths(rows: Sequence[tuple[str, ...]]) -> list[float]:
    """Inches of each column: what its texts need; where the page has less, the widest give way."""
    columns = list(zip_longest(*rows, fillvalue=""))
    needs = [max(text_width_in(text, TEXT_PT) for text in column) for column in columns]
    room = TEXT_IN - COLUMN_GAP_IN * (len(needs) - 1)
    spare = room - sum(needs)
    if spare >= 0.0:
        needs[0] += min(spare, max(0.0, NAMES_SHARE * TEXT_IN - needs[0]))
        return needs
    most = room
    for place, need in enumerate(sorted(needs)):
        most = room / (len(needs) - place)
        if need > most:
            break
        room -= need
    return [min(need, most) for need in needs]


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
