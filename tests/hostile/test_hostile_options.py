"""Numbers and names that no option takes: refused at once, or bounded with a note."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Cli, refused

USAGE = 2


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
    assert ran.code == USAGE
    assert "--" in ran.err
    assert "Traceback" not in ran.err
    assert not (tmp_path / "out").exists()


def test_a_width_beyond_all_cameras_is_refused(
    command: Cli, pictures: Path, tmp_path: Path
) -> None:
    ran = command("map", pictures, "--width", "999999999999", "--out", tmp_path / "out")
    refused(ran, "width", "8192")
    assert not (tmp_path / "out").exists()


# --- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ("map", "dive\udcff"),
        ("map", "dive", "--out", "map\udce9"),
        ("synth", "\udcff"),
        ("export", "dive\udcff", "--format", "restored"),
    ],
)
def test_a_name_that_is_not_utf_8_is_refused_readably(
    command: Cli, arguments: tuple[str, ...]
) -> None:
    refused(command(*arguments), "\\x", "rename")
