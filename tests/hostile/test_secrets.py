"""AquaFlow pointed at a file that is none of its own: no word of its content is shown."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from aquaflow.base.errors import reason_of
from tests.command_line import Cli

SECRET = "$6$saltsalt$hashhashhash"
SHADOW = f"root:{SECRET}:19000:0:99999:7:::\ndaemon:*:19000:0:99999:7:::\n"

VEHICLE = """
telemetry:
  devices:
    bus:
      kind: dbc
      link: {kind: can, channel: vcan0}
      database: %s
      samples: [{message: DEPTH, sample: depth, signals: [DEPTH_M]}]
"""


@pytest.fixture
def shadow(tmp_path: Path) -> Path:
    """A file that only the superuser may read, and AquaFlow runs as that."""
    file = tmp_path / "shadow"
    file.write_text(SHADOW)
    return file


@pytest.mark.parametrize(
    "text", [SHADOW, SECRET, f"a: {SECRET}: b", f"{SECRET}: 1\n", f"? {SECRET}"]
)
@pytest.mark.parametrize(
    "arguments",
    [
        ("config", "FILE"),
        ("run", "--config", "FILE"),
        ("record", "--config", "FILE"),
        ("map", "PICTURES", "--calib", "FILE"),
        ("map", "FILE"),
        ("run", "--source", "FILE"),
        ("run", "status", "--token-file", "FILE"),
        ("export", "DIVE", "--format", "restored"),
        ("view", "DIVE"),
        ("lab", "evaluate", "DIVE", "--truth", "FILE"),
        ("lab", "prior", "verify", "PRIOR"),
        ("lab", "prior", "export", "mast3r", "--checkpoint", "FILE", "--out", "OUT"),
    ],
    ids=" ".join,
)
def test_no_command_shows_what_a_foreign_file_holds(
    command: Cli, pictures: Path, tmp_path: Path, arguments: tuple[str, ...], text: str
) -> None:
    file, dive, prior = tmp_path / "shadow", tmp_path / "dive", tmp_path / "prior"
    file.write_text(text)
    dive.mkdir()
    prior.mkdir()
    for name in (
        *("config.yaml", "camera.yaml", "frames.csv", "trajectory.tum", "map.ply", "map.aqf"),
        *("metrics.json", "medium.json"),
    ):
        shutil.copy(file, dive / name)
    shutil.copy(file, prior / "prior.json")
    places = {
        "FILE": file, "DIVE": dive, "PRIOR": prior, "PICTURES": pictures, "OUT": tmp_path / "out",
    }  # fmt: skip
    ran = command(*(places.get(word, word) for word in arguments))
    assert ran.code == 1, ran
    assert "Traceback" not in ran.err
    assert "mistake" not in ran.err
    assert SECRET not in ran.err


def test_a_dbc_file_is_quoted_by_position_only(command: Cli, shadow: Path, tmp_path: Path) -> None:
    vehicle = tmp_path / "vehicle.yaml"
    vehicle.write_text(VEHICLE % shadow)
    ran = command("record", "--config", vehicle, "--out", tmp_path / "out")
    assert ran.code == 1
    assert str(shadow) in ran.err
    assert "line 1" in ran.err
    assert SECRET not in ran.err


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ValueError(f"could not convert string '{SECRET}' to float64"), "value error"),
        (ValueError(f'Invalid syntax at line 3, column 7: "{SECRET}"'), "line 3, column 7"),
        (FileNotFoundError(2, "No such file or directory", "x"), "No such file or directory"),
        (UnicodeDecodeError("utf-8", SECRET.encode(), 0, 1, "invalid"), "not text"),
        (RecursionError(SECRET), "nested"),
        (MemoryError(), "memory"),
    ],
)
def test_a_librarys_error_is_told_by_kind_and_position(error: Exception, words: str) -> None:
    said = reason_of(error)
    assert words in said
    assert SECRET not in said
