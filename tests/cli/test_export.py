"""Where exports go, several at once, and which recording they take their pictures from."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from aquaflow.base.errors.crash_report import MISUSED
from tests.command_line import Cli, refused

COARSE = ("--resolution", 0.3)
USAGE = 2


@pytest.mark.parametrize(
    ("format", "out", "written"),
    [
        ("laz", "ex", "ex/points.laz"),
        ("laz", "ex/reef.laz", "ex/reef.laz"),
        ("spz", "ex", "ex/map.spz"),
        ("ortho", "ex", "ex/ortho.tif"),
        ("ortho", "ex/reef.tif", "ex/reef.tif"),
        ("dem", "ex/heights.TIF", "ex/heights.TIF"),
        ("nerfstudio", "ex", "ex/transforms.json"),
    ],
)
def test_out_is_a_folder_unless_it_ends_as_the_formats_file_does(
    aquaflow: Cli, small_dive: Path, tmp_path: Path, format: str, out: str, written: str
) -> None:
    options = COARSE if format in ("ortho", "dem") else ()
    ran = aquaflow("export", small_dive, "--format", format, *options, "--out", tmp_path / out)
    assert ran.code == 0, ran.err
    assert (tmp_path / written).is_file()


def test_a_raster_that_is_named_leaves_other_files_and_has_its_quality_beside_it(
    aquaflow: Cli, small_dive: Path, tmp_path: Path
) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    out = tmp_path / "reef.tif"
    said = aquaflow("export", small_dive, "--format", "ortho", *COARSE, "--out", out, "--json").out
    assert json.loads(said)["files"] == [str(out), str(tmp_path / "reef_quality.tif")]
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["reef.tif", "reef_quality.tif", "thesis.txt"]


@pytest.mark.parametrize(
    ("formats", "out"), [("laz", "ex.tif"), ("colmap", "ex.ply"), ("laz,dem", "ex.laz")]
)
def test_a_file_of_another_format_is_refused(
    aquaflow: Cli, small_dive: Path, tmp_path: Path, formats: str, out: str
) -> None:
    ran = aquaflow("export", small_dive, "--format", formats, "--out", tmp_path / out)
    refused(ran, tmp_path / out, "folder", code=MISUSED)
    assert not list(tmp_path.iterdir())


def test_several_formats_are_those_of_each_alone(
    aquaflow: Cli, small_dive: Path, tmp_path: Path
) -> None:
    """Tracks of one drawing may not leak into another."""
    asked = ("export", small_dive, *COARSE, "--json")
    ran = aquaflow(*asked, "--format", "ortho,dem,laz,ply,obj", "--out", tmp_path / "all")
    said = json.loads(ran.out)
    assert set(said) == {"ortho", "dem", "laz", "ply", "obj"}
    for format, own in said.items():
        options = () if format == "laz" else COARSE
        aquaflow("export", small_dive, "--format", format, *options, "--out", tmp_path / format)
        files = [Path(name) for name in own.get("files", [own["out"]])]
        for file in files:
            assert file.read_bytes() == (tmp_path / format / file.name).read_bytes()


def test_a_format_that_fails_costs_no_other(
    aquaflow: Cli, small_dive: Path, tmp_path: Path
) -> None:
    ran = aquaflow(
        *("export", small_dive, "--format", "colmap,spz", "--recording", tmp_path / "none"),
        *("--out", tmp_path / "ex"),
    )
    assert ran.code == 1
    assert (tmp_path / "ex" / "map.spz").is_file()
    assert f"aquaflow: colmap: there is nothing at {tmp_path / 'none'}" in ran.err


@pytest.mark.parametrize("words", [(), ("--format", "laz,tiff"), ("--format", "laz", "--all")])
def test_a_format_that_does_not_exist_is_a_wrong_argument(
    aquaflow: Cli, small_dive: Path, words: tuple[str, ...]
) -> None:
    assert aquaflow("export", small_dive, *words).code == USAGE


def test_a_dive_remembers_where_its_recording_is(
    aquaflow: Cli, small_recording: Path, small_dive: Path, tmp_path: Path
) -> None:
    assert json.loads((small_dive / "metrics.json").read_text())["recording"] == str(
        small_recording.absolute()
    )
    ran = aquaflow("export", small_dive, "--format", "restored", "--out", tmp_path / "ex")
    assert str(small_recording) in ran.out
    assert list((tmp_path / "ex").glob("*_confidence.png"))
