"""`aquaflow export report`: a finished dive's folder as a PDF, or what is wrong with it."""

from __future__ import annotations

import html
import json
import shutil
from pathlib import Path

import pytest

from aquaflow.base.errors.crash_report import MISUSED
from aquaflow.dive.dive import Dive
from aquaflow.survey.coverage.coverage_file import read_coverage_file
from aquaflow.survey.report.report_of import report_of
from tests.command_line import Cli, refused


@pytest.fixture
def dive(small_dive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_dive, tmp_path / "dive"))


def test_a_finished_dive_has_its_coverage_and_a_map_from_above(small_dive: Path) -> None:
    numbers = json.loads((small_dive / "coverage.json").read_text())["0"]
    view = read_coverage_file(small_dive / "coverage.npz")[0]
    assert sum(numbers["area"].values()) > 0.0
    assert view.plan.classes.max() > 0
    for name in ("coverage.png", "overview.png"):
        assert (small_dive / name).read_bytes().startswith(b"\x89PNG")
    page = (small_dive / "report.html").read_text()
    assert "What was seen" in page
    assert "The map from above" in page


def test_the_folder_gives_back_what_the_report_showed(small_dive: Path) -> None:
    data = report_of(Dive(small_dive))
    page = (small_dive / "report.html").read_text()
    assert data.coverage is not None
    assert data.path is not None
    assert len(data.path.positions) == data.metrics["tracked"]
    assert len(data.timeline) == data.metrics["frames"]
    assert data.examples
    assert data.measures is not None
    assert data.measures.rows[0][1] in page
    assert all(note.split("&")[0] in page for note in data.notes if "'" not in note)


def test_the_waters_attenuation_has_its_sigma_and_start_values_are_no_findings(
    small_dive: Path,
) -> None:
    page = html.unescape((small_dive / "report.html").read_text())
    water = json.loads((small_dive / "medium.json").read_text())
    pairs = zip(water["attenuation_per_unit"], water["attenuation_relative_sigma"], strict=True)
    for value, sigma in pairs:
        assert f"{value:.3f} \u00b1 {value * sigma:.3f}" in page
    moved = [abs(share / 0.01 - 1.0) > 0.01 for share in water["backscatter"]["B_res"]]
    assert ("near backscatter" in page) == any(moved)


def test_the_ground_in_numbers_is_that_of_the_page_until_its_unit_changes(dive: Path) -> None:
    page, rows = (dive / "report.html").read_text(), report_of(Dive(dive)).reef
    assert len(rows) > 5
    for row in rows:
        assert html.escape(row.label) in page
        assert html.escape(row.value) in page
        assert html.escape(row.interval) in page
    numbers = dive / "reef_numbers.json"
    content = json.loads(numbers.read_text())
    numbers.write_text(json.dumps(content | {"unit": "furlongs"}))
    assert report_of(Dive(dive)).reef == []


def test_a_report_is_never_written_over_what_is_no_pdf(dive: Path, command: Cli) -> None:
    before = (dive / "camera.yaml").read_bytes()
    ran = command("export", "report", dive, "--pdf", dive / "camera.yaml")
    refused(ran, "does not end in .pdf", code=MISUSED)
    assert (dive / "camera.yaml").read_bytes() == before


def test_report_writes_a_pdf_where_it_is_told_to(dive: Path, command: Cli, tmp_path: Path) -> None:
    ran = command("export", "report", dive, "--pdf", tmp_path / "reef.pdf", "--json")
    assert ran.code == 0, ran.err
    said = json.loads(ran.out)
    assert (tmp_path / "reef.pdf").read_bytes().startswith(b"%PDF")
    assert said["pages"] >= 3
    ran = command("export", "report", dive)
    assert ran.code == 0, ran.err
    assert (dive / "report.pdf").stat().st_size > 20_000


@pytest.mark.parametrize(
    "name", ["metrics.json", "trajectory.csv", "medium.json", "coverage.npz", "reef_numbers.json"]
)
def test_a_damaged_file_is_named_in_a_sentence(dive: Path, command: Cli, name: str) -> None:
    (dive / name).write_bytes(b"{\x00 damaged")
    refused(command("export", "report", dive), name)


def test_a_dive_of_before_this_command_has_a_report_without_coverage(
    dive: Path, command: Cli
) -> None:
    for name in ("coverage.npz", "coverage.json", "overview.png"):
        (dive / name).unlink()
    (dive / "heldout").joinpath("000000_real.png").write_bytes(b"no picture")
    ran = command("export", "report", dive)
    assert ran.code == 0, ran.err
