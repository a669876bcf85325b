"""Names of files that a spreadsheet, a terminal or a browser would obey."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import pytest

from aquaflow.base.errors import printable
from aquaflow.dive.dive import Dive
from aquaflow.dive.frames_csv import read_rows
from aquaflow.survey.report.page import render_report
from aquaflow.survey.report.report_of import report_of
from tests.command_line import Cli, refused
from tests.small_recording import HASTY

HOSTILE = '=HYPERLINK("{:03d}")\x1b[31m<script>alert(1)<%s>\n\u202e\'&;=cmd.png'
COMMANDS = "\x1b\x07\r\u202e"


@pytest.fixture(scope="module")
def recording(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures with such names, and one of 255 bytes."""
    folder = tmp_path_factory.mktemp("hostile") / "images"
    folder.mkdir()
    pictures = sorted((small_recording / "images").glob("*.png"))
    for number, picture in enumerate(pictures[:-1]):
        shutil.copy(picture, folder / HOSTILE.format(number))
    shutil.copy(pictures[-1], folder / ("~" + "x" * 250 + ".png"))
    return folder


@pytest.fixture(scope="module")
def dive(
    recording: Path,
    small_recording: Path,
    aquaflow: Cli,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    out = tmp_path_factory.mktemp("mapped") / "dive"
    calibration = ("--calib", small_recording / "camera.yaml")
    ran = aquaflow("map", recording, *calibration, "--tracking-only", *HASTY, "--out", out)
    assert ran.code in (0, 3), ran.err
    assert not set(COMMANDS) & set(ran.out + ran.err)
    return out


def test_a_picture_named_as_a_formula_is_no_formula_in_the_table(
    dive: Path, recording: Path
) -> None:
    with (dive / "frames.csv").open(newline="", encoding="utf-8") as stream:
        cells = [row["source"] for row in csv.DictReader(stream)]
    assert cells[0].startswith("'=HYPERLINK")
    names = sorted(each.name for each in recording.iterdir())
    assert [row.source for row in read_rows(dive / "frames.csv")] == [*map(printable, names)]


def test_no_file_of_the_dive_holds_what_a_terminal_obeys(dive: Path) -> None:
    for name in ("frames.csv", "report.html", "log.jsonl", "metrics.json"):
        text = (dive / name).read_text(encoding="utf-8")
        assert not set(COMMANDS) & set(text), name
    assert "<script>alert" not in (dive / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["a\x1b[31mb", "a\x07", "a\u202egpj.exe", "a\rb", "a\x9b31m"])
def test_a_name_that_a_terminal_obeys_is_refused_without_being_obeyed(
    command: Cli, tmp_path: Path, name: str
) -> None:
    for words in (("map",), ("export", "report"), ("view",)):
        ran = command(*words, tmp_path / name)
        refused(ran)
        assert not set(COMMANDS) & set(ran.err)
        assert "rename the file or folder" in ran.err


def test_a_dive_whose_name_is_no_formula_of_mathematics_has_a_pdf(
    dive: Path, command: Cli, tmp_path: Path
) -> None:
    copy = tmp_path / "$\\frac{x$%s<script>"
    shutil.copytree(dive, copy)
    ran = command("export", "report", copy, "--pdf", tmp_path / "report.pdf")
    assert ran.code == 0, ran.err
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")


def test_a_report_made_inside_a_folder_of_such_a_name_shows_it_as_text(
    dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "dive\x1b[31m<script>alert(1)"
    shutil.copytree(dive, copy)
    monkeypatch.chdir(copy)
    page = render_report(report_of(Dive(Path())))
    assert not set(COMMANDS) & set(page)
    assert "<script>alert" not in page
    assert "dive\\x1b[31m&lt;script&gt;" in page


def test_an_error_shows_a_name_from_inside_a_folder_as_text(command: Cli, tmp_path: Path) -> None:
    (tmp_path / "a\x1b[31m.png").write_bytes(b"no picture")
    ran = command("map", tmp_path, "--out", tmp_path / "out")
    refused(ran)
    assert not set(COMMANDS) & set(ran.err)
