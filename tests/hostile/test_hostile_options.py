"""Numbers and names that no option takes: refused at once, or bounded with a note."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors.crash_report import MISUSED
from tests.command_line import Cli, refused
from tests.small_recording import HASTY


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "--seconds", "inf"),
        ("run", "--seconds", "nan"),
        ("record", "--seconds", "nan"),
        ("record", "--seconds", "inf"),
        ("record", "--seconds=-1"),
        ("run", "--speed", "nan"),
        ("run", "--speed", "inf"),
        ("run", "--seconds", "1e300"),
    ],
)
def test_a_time_that_no_clock_waits_for_is_a_usage_error(
    command: Cli, pictures: Path, tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    ran = command(*arguments, "--source", pictures, "--out", tmp_path / "out")
    assert ran.code == MISUSED
    assert "--" in ran.err
    assert "Traceback" not in ran.err
    assert not (tmp_path / "out").exists()


def test_a_width_beyond_all_cameras_is_refused(
    command: Cli, pictures: Path, tmp_path: Path
) -> None:
    ran = command("map", pictures, "--width", "999999999999", "--out", tmp_path / "out")
    refused(ran, "width", "8192", code=MISUSED)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("threads", ["100000"])
def test_more_threads_than_cores_are_not_started(
    aquaflow: Cli, small_recording: Path, tmp_path: Path, threads: str
) -> None:
    ran = aquaflow(
        "map",
        small_recording,
        "--stop",
        12,
        "--threads",
        threads,
        "--out",
        tmp_path / "out",
        *HASTY,
    )
    assert ran.code == 0, ran.err
    (note,) = ran.err.splitlines()
    assert note.startswith("note: ")
    assert threads in note
    assert str(os.cpu_count()) in note


@pytest.mark.parametrize("size", [(160, 1), (1, 160)])
def test_pictures_one_pixel_high_or_wide_are_refused(
    aquaflow: Cli, tmp_path: Path, size: tuple[int, int]
) -> None:
    width, height = size
    folder = tmp_path / "thin"
    folder.mkdir()
    for i in range(4):
        cv2.imwrite(str(folder / f"{i}.png"), np.zeros((height, width, 3), np.uint8))
    for name in ("map", "run"):
        given = [folder] if name == "map" else ["--source", folder, "--speed", 100]
        ran = aquaflow(name, *given, "--out", tmp_path / name)
        assert ran.code in ((1,) if name == "map" else (1, 3))
        assert "Traceback" not in ran.err
        assert "mistake" not in ran.err


def test_a_crop_one_pixel_high_is_refused(aquaflow: Cli, pictures: Path, tmp_path: Path) -> None:
    ran = aquaflow("map", pictures, "--crop", "0,0,160,1", "--out", tmp_path / "out")
    refused(ran, "16")


# --- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ("map", "dive\udcff"),
        ("map", "dive", "--out", "map\udce9"),
        ("lab", "synth", "\udcff"),
        ("export", "dive\udcff", "--format", "restored"),
    ],
)
def test_a_name_that_is_not_utf_8_is_refused_readably(
    command: Cli, arguments: tuple[str, ...]
) -> None:
    refused(command(*arguments), "\\x", "rename")


def test_pictures_whose_names_are_not_utf_8_are_mapped(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for i, file in enumerate(sorted((small_recording / "images").iterdir())[:8]):
        prefix = b"\xe9\n" if i < 4 else b""
        target = os.fsencode(folder) + b"/" + prefix + os.fsencode(file.name)
        Path(os.fsdecode(target)).write_bytes(file.read_bytes())
    ran = aquaflow("map", folder, "--out", tmp_path / "out", *HASTY)
    assert ran.code == 0, ran.err
    table = (tmp_path / "out" / "frames.csv").read_text(encoding="utf-8")
    assert "\\xe9\\n000003.png" in table


# --- folders --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("--format", "laz", "--out"), "points.laz"),
        (("--format", "e57", "--out"), "points.e57"),
        (("--format", "spz", "--out"), "map.spz"),
        (("--format", "mcap", "--out"), "dive.mcap"),
        (("--format", "ply", "--out"), "mesh.ply"),
        (("--format", "restored", "--out"), "pictures"),
        (("report", "--pdf"), "dive.pdf"),
        (("video", "--kind", "fly-through", "--seconds", "0.2", "--out"), "flight.mp4"),
    ],
    ids=lambda each: each if isinstance(each, str) else "",
)
def test_the_folder_of_an_output_is_made(
    command: Cli, small_dive: Path, tmp_path: Path, words: tuple[str, ...], name: str
) -> None:
    out = tmp_path / "new" / "folder" / name
    named = (words[0], small_dive, *words[1:]) if words[0][0] != "-" else (small_dive, *words)
    ran = command("export", *named, out)
    assert ran.code == 0, ran.err
    assert out.exists()


def test_an_export_to_where_no_folder_can_be_is_refused(
    command: Cli, small_dive: Path, tmp_path: Path
) -> None:
    file = tmp_path / "file"
    file.write_text("thesis")
    for kind in ("restored", "laz"):
        for place in (Path("/proc/aquaflow/x"), file / "below", file / "far" / "below"):
            refused(command("export", small_dive, "--format", kind, "--out", place), place)
    refused(command("export", small_dive, "--format", "restored", "--out", file), file)
    assert file.read_text() == "thesis"
