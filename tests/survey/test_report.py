"""The report opens offline, says what happened, and is the same for the same dive."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from aquaflow.dive.fixes_csv import FixRow
from aquaflow.survey.report.data import (
    CameraSummary,
    HeldOutExample,
    Measures,
    MediumCurves,
    PathPlot,
    ReefRow,
    ReportData,
)
from aquaflow.survey.report.page import render_report, write_report
from aquaflow.telemetry.world_frame import SourceReport

CAMERA = CameraSummary(640, 360, 544.0, "guessed")
VOID = {"br", "meta", "img", "path", "use", "rect"}


def report(**changes: object) -> ReportData:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (36, 64, 3), dtype=np.uint8)
    data = ReportData(
        name="Dive <1> & more",
        camera=CAMERA,
        metrics={
            "frames": 12,
            "tracked": 10,
            "psnr": 24.125,
            "lpips": None,
            "heldout_frames": 1,
            "version": "0.1.0",
            "stage_ms": {"encode": {}},
        },
        path=PathPlot(
            rng.normal(size=(10, 3)),
            ["keyframe", *["common"] * 9],
            [0] * 6 + [1] * 4,
            truth=rng.normal(size=(5, 3)),
        ),
        timeline=["keyframe", *["common"] * 9, "lost", "dropped"],
        examples=[HeldOutExample("frame 8", image, image, image, 24.1, 0.8)],
        medium=MediumCurves(
            (0.5, 0.1, 0.1),
            (0.4, 0.3, 0.3),
            (0.1, 0.3, 0.4),
            (0.0, 0.0, 0.0),
            (1.0, 1.0, 1.0),
            0.5,
            4.0,
        ),
        stages={"encode": {"count": 12, "total": 600.0, "p50": 50.0, "p95": 60.0}},
        notes=["2 of 14 pictures were left out"],
    )
    return replace(data, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def page():
    """The full report, rendered once."""
    return render_report(report())


class Balance(HTMLParser):
    """Collects tags that are closed in the wrong order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: object) -> None: ...

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID and (not self.open or self.open.pop() != tag):
            self.wrong.append(tag)


def test_page_is_well_formed_and_escapes_names(page):
    parser = Balance()
    parser.feed(page)

    assert parser.wrong == []
    assert parser.open == []
    assert "Dive &lt;1&gt; &amp; more" in page
    assert "<1>" not in page


def test_page_loads_nothing_from_outside(page):
    loaded = re.findall(r'(?:src|href)="([^"]*)"', page)

    assert loaded
    assert all(link.startswith(("data:", "#")) for link in loaded)
    assert "<script" not in page
    assert "@import" not in page
    assert not re.search(r"url\((?!#)", page)


def test_ids_are_unique_across_figures(page):
    ids = re.findall(r'\bid="([^"]*)"', page)

    assert len(ids) == len(set(ids))


def test_same_dive_gives_the_same_bytes(tmp_path, page):
    write_report(tmp_path / "report.html", report())

    assert (tmp_path / "report.html").read_bytes() == page.encode()


def test_every_section_says_its_content_in_a_sentence(page):

    for text in (
        "10 of 12 frames have a pose.",
        "reach 24.1 dB",
        "the dashed line is the true path",
        "there are several sub-maps",
        "At 4 map units the water has taken 86 % of the red light.",
        "1 lost: no pose found",
        "guessed, as no calibration was given",
        "2 of 14 pictures were left out",
        "not measured",
    ):
        assert text in page or text[0].lower() + text[1:] in page.lower(), text


def test_empty_dive_still_has_a_report():
    page = render_report(ReportData("empty", CAMERA, {}))

    assert "No path was found" in page
    assert "none was modelled" in page
    assert "held-out" not in page


@pytest.mark.parametrize("positions", [np.zeros((2, 3)), np.eye(3)[:2], np.full((4, 3), np.nan)])
def test_degenerate_paths_do_not_break_the_report(positions):
    path = PathPlot(positions, ["common"] * len(positions), [0] * len(positions))

    assert "The path" in render_report(report(path=path))


def test_a_level_path_is_seen_from_above_and_from_the_side():
    positions = np.cumsum(np.full((10, 3), 0.3), axis=0)
    path = PathPlot(
        positions, ["common"] * 10, [0] * 10, unit="m", up="true north", depth_known=True
    )
    page = render_report(report(path=path))

    for text in ("seen from above", "From above, true north up", "true north, m", "depth, m"):
        assert text in page, text
    assert "Widest view" not in page


def test_sub_maps_that_telemetry_placed_are_called_so():
    path = replace(report().path, placed=True)

    assert "telemetry says how they lie" in render_report(report(path=path))


def test_every_source_of_telemetry_is_listed_with_what_became_of_it():
    sources = [
        SourceReport("bar30", "depth", 1480, 3),
        SourceReport("dvl <a50>", "velocity", 0, 0, "no sample in the dive"),
    ]
    measures = Measures([("length of the path", "34.2 \u00b1 0.1 m")], sources)
    page = render_report(report(measures=measures))

    for text in (
        "<td>length of the path</td><td>34.2 \u00b1 0.1 m</td>",
        '<td>bar30</td><td>depth</td><td class="n">1,480</td><td class="n">3</td>',
        "<td>dvl &lt;a50&gt;</td>",
        "<td>no sample in the dive</td>",
    ):
        assert text in page, text
    assert "No telemetry was used" in render_report(report(measures=Measures([])))
    parser = Balance()
    parser.feed(page)
    assert parser.wrong == []


def test_figures_take_the_page_s_colours(page):

    assert "currentColor" in page
    assert "#010203" not in page
    assert "#040506" not in page


def test_a_transparent_restored_picture_and_its_confidence_are_shown():
    image = np.full((36, 64, 3), 200, np.uint8)
    clear = np.dstack([np.zeros_like(image), np.zeros((36, 64), np.uint8)])
    grey = np.full((36, 64), 90, np.uint8)
    example = HeldOutExample("frame 8", image, image, clear, 24.1, 0.8, grey)
    page = render_report(report(examples=[example]))
    shown = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))
        for data in re.findall(r'src="data:image/jpeg;base64,([^"]*)"', page)
    ]

    assert [picture.shape for picture in shown] == [(36, 64, 3)] * 3 + [(36, 64)]
    np.testing.assert_allclose(shown[2], 128, atol=2)
    assert "restored from the picture" in page


def test_date_is_shown_only_when_given(page):
    assert "on 2 May 2026" in render_report(ReportData("d", CAMERA, {}, written="2 May 2026"))
    assert not re.search(r"\b20\d\d-\d\d-\d\d", page)


def test_the_grounds_numbers_stand_with_their_intervals() -> None:
    row = ReefRow("rugosity", "1.25 \u00b1 0.01", "1.23 to 1.27", "on cells of <0.1> m")
    page = render_report(report(reef=[row]))
    assert "The ground in numbers" in page
    assert "1.23 to 1.27" in page
    assert "on cells of &lt;0.1&gt; m" in page
    assert "The ground in numbers" not in render_report(report())


def test_fixes_are_drawn_and_listed_and_of_many_the_worst() -> None:
    fix = FixRow(0.0, "<1>.jpg", "usbl", 0, -31.7, 115.0, 0.05, 0.04, -0.03, 0.05, 0.7, False)
    metrics = {
        "fixes": {"count": 9, "rejected": 1, "rms_m": 0.0512, "largest_m": 0.2, "rms_sigmas": 0.9}
    }
    fixes = [replace(fix, t_s=float(k), longitude_deg=115.0 + 1e-5 * k) for k in range(8)]
    fixes.append(replace(fix, picture="far.jpg", error_m=3.0, error_east_m=3.0, rejected=True))
    page = render_report(report(fixes=fixes, metrics=metrics))
    for text in ("&lt;1&gt;.jpg", "+0.040", "RMS 0.0512 m", "From each fix", "<td>rejected</td>"):
        assert text in page, text
    parser = Balance()
    parser.feed(page)
    assert parser.wrong == []
    many = [*fixes, *(replace(fix, picture="near.jpg", error_m=0.01) for _ in range(40))]
    page = render_report(report(fixes=many, metrics=metrics))
    assert page.count("<td>near.jpg</td>") == 31
    assert "<td>far.jpg</td>" in page
    assert "Position fixes" not in render_report(report())


def test_one_fix_that_is_exact_is_drawn() -> None:
    fix = FixRow(0.0, "", "gps", 0, 0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 0.0, False)
    assert "<td>0.00 s</td>" in render_report(report(fixes=[fix]))
