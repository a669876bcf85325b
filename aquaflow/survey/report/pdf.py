"""The report as a PDF: the same values on A4 pages, by matplotlib's own writer."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from aquaflow.base.storage.atomic import atomic_write
from aquaflow.survey.report import survey_sections
from aquaflow.survey.report.data import HeldOutExample, ReportData
from aquaflow.survey.report.figures import STYLE, level_axes, medium_axes, path_axes
from aquaflow.survey.report.pdf_text import Pages
from aquaflow.survey.report.sections import MINIMUM_PATH, TILES
from aquaflow.survey.report.survey_figures import coverage_axes, profile_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
        pages.paragraph(survey_sections.coverage_words(view))
        pages.drawing(PLAN_IN, coverage_axes, view)
        pages.table(survey_sections.coverage_rows(view))
    if data.overview is not None:
        pages.heading("The map from above, without water", OVERVIEW_IN)
        pages.picture(_decode(data.overview), OVERVIEW_IN)
    if data.profile is not None:
        pages.heading("Depth and altitude", PROFILE_IN)
        pages.drawing(PROFILE_IN, profile_axes, data.profile)
    if data.reef:
        pages.heading("The ground in numbers, each with 1 sigma and its 95 % interval")
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
    rows = [("", *survey_sections.RGB), *survey_sections.water_rows(data.medium)]
    pages.table(rows)
    pages.paragraph(survey_sections.visibility_words(data.medium))


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
