"""Pages of the PDF: nothing is drawn over anything else, whatever a dive has to say."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.textpath import text_to_path

from aquaflow.survey.report.data import (
    CameraSummary,
    DepthProfile,
    HeldOutExample,
    LeftOut,
    Measures,
    MediumCurves,
    PathPlot,
    ReefRow,
    ReportData,
)
from aquaflow.survey.report.figures import STYLE
from aquaflow.survey.report.pdf import MARGIN_IN, write_pages

Box = tuple[float, float, float, float]
"""Left, bottom, right, top: px."""
TOUCHING_PX = 2.0
"""Text extents include room for letters that a text may not have."""


class DrawnPages:
    """Takes pages as a PDF would, and keeps where each text of them was drawn."""

    def __init__(self) -> None:
        self.texts: list[list[tuple[str, Box]]] = []
        self.width_px = 0.0
        self.margin_px = 0.0

    def savefig(self, figure: Figure) -> None:
        drawn: list[tuple[str, Box]] = []
        renderer: Any = FigureCanvasAgg(figure).get_renderer()

        def note(gc: Any, x: float, y: float, text: str, font: Any, angle: float, **_: Any) -> None:
            # Not the renderer's own extents: it rounds letters to its pixels, a PDF does not.
            measured = text_to_path.get_text_width_height_descent(text, font, False)
            width, height, below = (each * figure.dpi / 72.0 for each in measured)
            y = renderer.height - y
            level = (x, y - below, x + width, y + height - below)
            upright = (x - height + below, y, x + below, y + width)
            drawn.append((text, upright if angle == 90.0 else level))

        renderer.draw_text = note
        figure.draw(renderer)
        self.texts.append(drawn)
        self.width_px = float(figure.bbox.width)
        self.margin_px = MARGIN_IN * figure.dpi


def overprints(pages: DrawnPages) -> Iterator[tuple[int, str, str]]:
    """Page and texts of which one is drawn over the other, or that leave the page's margins."""
    for number, texts in enumerate(pages.texts, 1):
        for i, (text, (left, bottom, right, top)) in enumerate(texts):
            if left < pages.margin_px - 1.0 or right > pages.width_px - pages.margin_px + 1.0:
                yield number, text, "margin"
            for other, box in texts[i + 1 :]:
                across = min(right, box[2]) - max(left, box[0])
                along = min(top, box[3]) - max(bottom, box[1])
                if min(across, along) > TOUCHING_PX:
                    yield number, text, other


def drawn(data: ReportData) -> DrawnPages:
    pages = DrawnPages()
    with mpl.rc_context(STYLE):
        write_pages(pages, data)  # type: ignore[arg-type]
    return pages


def talkative() -> ReportData:
    """A dive with more to say about everything than fits in a line."""
    words = "the cameras look at the ground from 61 degrees aside, and nothing says which way is"
    random = np.random.default_rng(0)
    picture = random.integers(0, 255, (27, 48, 3), dtype=np.uint8)
    places = np.cumsum(random.normal(size=(80, 3)), axis=0)
    time = np.arange(80.0)
    return ReportData(
        name="A dive along the northern slope of the long reef beside the harbour, second day",
        camera=CameraSummary(1920, 1080, 1105.2, "calibrated"),
        metrics={"frames": 80, "tracked": 80, "psnr": 24.1, "gaussians": 1_234_567},
        warnings=[words],
        path=PathPlot(
            places, ["keyframe"] * 80, [i // 10 for i in range(80)], unit="m",
            up="magnetic north",
        ),
        measures=Measures([("scale from", words * 3), ("a name that is long: " + words, "1")]),
        reef=[
            ReefRow("surface of the ground with its relief, of what was mapped",
                    "1234567.8 \u00b1 123456.7 m\u00b2", "1000000.0 to 1500000.0", ""),
            ReefRow("relief", "unknown", "", words),
            ReefRow("letters", "W" * 200, "", words * 20),
        ],
        examples=[HeldOutExample("frame 8", picture, picture, picture)] * 6,
        medium=MediumCurves(
            (0.5, 0.1, 0.1), (0.4, 0.3, 0.3), (0.1, 0.3, 0.4), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0),
            0.5, 4.0, white=("daylight:coastal_1C", (1.0, 1.2, 1.4), (0.1, 0.1, 0.1)),
        ),
        profile=DepthProfile(
            time, places[:, 0], places[:, 1], "camera, down from where the vehicle began to dive"
        ),
        left_out=[LeftOut("skipped", f"{number} {words}", 1_234) for number in range(12)],
        notes=[words * 4] * 9,
    )  # fmt: skip


@pytest.mark.parametrize("up", ["magnetic north", ""])
def test_no_text_of_a_page_lies_over_another_or_in_its_margins(up: str) -> None:
    data = talkative()
    assert data.path is not None
    pages = drawn(replace(data, path=replace(data.path, up=up)))
    assert len(pages.texts) >= 4
    assert list(overprints(pages)) == []


def test_headings_stay_with_what_they_are_about_and_short_tables_are_not_torn() -> None:
    """Wherever on a page they come."""
    for notes in range(40, 56):
        pages = drawn(ReportData("d", talkative().camera, {}, notes=["a note"] * notes))
        (with_camera,) = (page for page in pages.texts if "picture" in dict(page))
        assert {"The camera", "focal length"} < set(dict(with_camera))
