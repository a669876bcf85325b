"""What the report says of a survey, and the same as a PDF."""

from __future__ import annotations

import io
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from aquaflow.dive.frames_csv import FrameRow
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.survey.coverage.classes import CoverageClass
from aquaflow.survey.report import sections as survey_sections
from aquaflow.survey.report.data import (
    CameraSummary,
    DepthProfile,
    HeldOutExample,
    LeftOut,
    Measures,
    MediumCurves,
    PathPlot,
    ReportData,
)
from aquaflow.survey.report.page import render_report
from aquaflow.survey.report.pdf import write_pdf
from aquaflow.survey.report.report_of import MOST_REASONS, left_out, profile
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.water.mounting import Lamp
from tests.survey.coverage.surveys import lawnmower, metric, survey_of

VIEW = survey_of(lawnmower(3, 6.0, 1.0, 0.45))
WATER = MediumCurves(
    (0.6, 0.2, 0.3), (0.5, 0.3, 0.3), (0.05, 0.3, 0.4), (0.0, 0.01, 0.01), (0.4, 0.4, 0.4),
    1.0, 4.0, "m", beta_sigma=(0.1, 0.2, 0.54),
)  # fmt: skip
TIMES = np.linspace(0.0, 600.0, 50)


def overview() -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.full((20, 30, 4), 90, np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()


def survey(**changes: object) -> ReportData:
    path = np.column_stack([VIEW.path, np.full(len(VIEW.path), 8.0)])
    picture = np.full((24, 32, 3), 120, np.uint8)
    data = ReportData(
        name="Reef <1>",
        camera=CameraSummary(640, 360, 544.0, "calibrated"),
        metrics={"frames": 60, "tracked": 58, "psnr": 31.0, "stage_ms": {}, "notes": ["a note"]},
        path=PathPlot(path, ["keyframe"] * len(path), [0] * len(path), "m", "true north", True),
        measures=Measures([("unit of length", "metres")]),
        coverage=VIEW,
        overview=overview(),
        profile=DepthProfile(
            TIMES, 8.0 + np.sin(TIMES / 60), 2.0 + 0 * TIMES, "depth of the camera"
        ),
        left_out=[LeftOut("lost", "few matches <N>", 2)],
        medium=WATER,
        examples=[HeldOutExample("frame 8", picture, picture, picture)] * 5,
        notes=["a note " * 40],
    )
    return replace(data, **changes)  # type: ignore[arg-type]


def test_lamps_are_named_where_there_are_any_with_their_places_where_those_are_known() -> None:
    assert "Lamps light the scene" not in render_report(survey())
    lamp = Lamp(0.82, 2.0, 1.5)
    page = render_report(survey(medium=replace(WATER, lamp=lamp)))
    assert "82% of the light is theirs at 1.5 m" in page
    assert "below the camera" not in page
    places = ((-0.2, -0.1), (0.2, -0.1))
    known = replace(lamp, share_sigma=0.04, places=places, places_sigma=(0.03, 0.02))
    page = render_report(survey(medium=replace(WATER, lamp=known)))
    assert "82% \u00b1 4% of the light" in page
    assert "(-0.20, -0.10) and (0.20, -0.10) m right of and below" in page


def test_the_page_says_what_was_seen_and_how_deep_and_in_which_water() -> None:
    page = render_report(survey())
    for words in (
        "What was seen", "seen well", "too far for this water", "The map from above",
        "Depth and altitude", "The water in numbers", "What was left out, and why",
        "few matches &lt;N&gt;", "data:image/png;base64,",
    ):  # fmt: skip
        assert words in page
    assert page == render_report(survey())


def test_what_is_not_known_has_no_section() -> None:
    page = render_report(
        survey(coverage=None, overview=None, profile=None, left_out=(), medium=None)
    )
    for words in ("What was seen", "The map from above", "Depth and altitude", "in numbers"):
        assert words not in page


def test_shares_of_the_classes_are_of_what_was_seen() -> None:
    rows = dict(survey_sections.coverage_rows(VIEW))
    shares = [int(re.findall(r"\((\d+) %\)", rows[name])[0]) for name in list(rows)[:3]]
    assert sum(shares) == pytest.approx(100, abs=2)
    assert rows["survey lines"].startswith("3, together 1")
    assert f"{VIEW.area(CoverageClass.WELL):.3g}" in rows["seen well"]


def test_the_water_is_in_numbers_of_a_unit_that_is_said() -> None:
    rows = {name: values for name, *values in survey_sections.water_rows(WATER)}
    attenuation = ["0.600 \u00b1 0.060", "0.200 \u00b1 0.040", "0.300 \u00b1 0.162"]
    assert rows["attenuation of the scene's light, 1/m"] == attenuation
    assert rows["half of the light is lost over, m"][1] == "3.466 \u00b1 0.693"
    assert "Visibility: 15 m" in survey_sections.visibility_words(WATER)
    assert "that of the visibility is 20%" in survey_sections.visibility_words(WATER)
    unsure = survey_sections.visibility_words(replace(WATER, beta_sigma=None))
    assert "How sure the attenuation is, is not known" in unsure
    assert "extrapolated" in survey_sections.visibility_words(WATER)
    assert survey_sections.lightness_words(WATER) == ""
    far = replace(WATER, lightness=(0.834, 1.012))
    assert "83% as light" in survey_sections.lightness_words(far)
    assert "101% without the water" in survey_sections.lightness_words(far)
    in_units = replace(WATER, unit="map units")
    assert "attenuation of the scene's light, 1/map unit" in {
        row[0] for row in survey_sections.water_rows(in_units)
    }


def test_what_is_still_as_it_started_is_no_finding() -> None:
    rows = {name: values for name, *values in survey_sections.water_rows(WATER)}
    assert rows["near backscatter, share"] == ["0.000", "", ""]
    assert rows["decay of near backscatter, 1/m"] == ["0.400", "", ""]
    unmoved = replace(WATER, B_res=(0.00999, 0.01, 0.01))
    assert not [row[0] for row in survey_sections.water_rows(unmoved) if "near" in row[0]]


def test_a_chosen_white_balance_is_reported_with_its_certainty() -> None:
    chosen = replace(WATER, white=("neutral", (1.42, 0.94, 0.86), (0.1, 0.05, 0.05)))
    name, *values = survey_sections.water_rows(chosen)[-1]
    assert name == "gain of the white balance, neutral"
    assert values == ["1.42 \u00b1 0.14", "0.94 \u00b1 0.05", "0.86 \u00b1 0.04"]


def rows(depth: float | None, altitude: float | None, unit: str = "m") -> list[PoseRow]:
    return [
        PoseRow(i, 0.1 * i, None, 0, 0.0, 0.0, 5.0, unit, depth_m=depth, altitude_m=altitude)
        for i in range(4)
    ]


def test_the_profile_is_what_the_vehicle_measured_else_the_paths() -> None:
    measured = profile(rows(7.0, 2.0), metric())
    assert measured is not None
    assert (measured.depth == 7.0).all()
    assert (measured.altitude == 2.0).all()
    of_path = profile(rows(None, None), replace(metric(), depth_known=True))
    assert of_path is not None
    assert (of_path.depth == 5.0).all()
    assert of_path.depth_is == "depth of the camera"
    assert profile(rows(None, None, "map units"), WorldFrame.unknown()) is None


def test_reasons_that_differ_in_numbers_are_one_and_rare_ones_are_summed() -> None:
    frames = [FrameRow(i, "x", 0.0, "skipped", reason=f"blur of {i}.5 px") for i in range(5)]
    frames += [
        FrameRow(9, "x", 0.0, "lost", reason=f"why {'abcdefghijklmnop'[i]}") for i in range(16)
    ]
    frames += [FrameRow(9, "x", 0.0, "common")]
    found = left_out(frames)
    assert found[0] == LeftOut("skipped", "blur of N px", 5)
    assert len(found) == MOST_REASONS + 1
    assert sum(each.count for each in found) == 21


# --- as a PDF -------------------------------------------------------------------------------------


def texts_of(pdf: bytes) -> int:
    """Streams of the file that decompress: every page and picture of a sound file."""
    streams = re.findall(rb"FlateDecode.*?stream\r?\n(.*?)\nendstream", pdf, re.DOTALL)
    return sum(bool(zlib.decompress(each)) for each in streams)


WITHOUT_DRAWINGS = {
    "coverage": None,
    "overview": None,
    "profile": None,
    "examples": (),
    "path": None,
}
"""For words alone: drawings take most of the time that a PDF takes."""


def test_a_pdf_is_whole_and_has_the_pages_that_it_is_said_to_have(tmp_path: Path) -> None:
    pages = write_pdf(tmp_path / "a.pdf", survey())
    content = (tmp_path / "a.pdf").read_bytes()
    assert content.startswith(b"%PDF-1.")
    assert content.rstrip().endswith(b"%%EOF")
    assert len(re.findall(rb"/Type /Page\b", content)) == pages >= 4
    assert texts_of(content) >= pages


def test_a_long_list_goes_on_on_another_page(tmp_path: Path) -> None:
    short = write_pdf(tmp_path / "a.pdf", survey(**WITHOUT_DRAWINGS))
    notes = [f"note {i} with $odd$ text" for i in range(150)]
    assert write_pdf(tmp_path / "b.pdf", survey(**WITHOUT_DRAWINGS, notes=notes)) >= short + 2


def test_a_dive_that_knows_nothing_has_one_page(tmp_path: Path) -> None:
    empty = ReportData("none", CameraSummary(64, 48, 50.0, "guessed"), {})
    assert write_pdf(tmp_path / "a.pdf", empty) == 1
