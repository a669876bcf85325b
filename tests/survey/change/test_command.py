"""`aquaflow change` on the command line: wrong arguments, and a whole comparison."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.errors.crash_report import FAILED, MISUSED
from aquaflow.survey.change.find_changes import refuse_taken
from tests.command_line import Cli


@pytest.mark.parametrize(
    ("arguments", "said", "code"),
    [
        (["--from", "nowhere", "--to", "nowhere"], "there is no folder nowhere", FAILED),
        (["--from", "a", "--to", "b", "--cylinder", "-1"], "--cylinder -1 is no length", MISUSED),
        (["--from", "a", "--to", "b", "--reach", "nan"], "--reach nan is no length", MISUSED),
        (["--from", "a", "--to", "b", "--false", "0"], "--false 0 is no share", MISUSED),
        (["nowhere", "--from", "a", "--to", "b"], "nowhere is no site", FAILED),
        (["S", "--from", "a", "--to", "b", "--transform", "T"], "leave out --transform", MISUSED),
    ],
)
def test_wrong_arguments_are_refused_in_one_sentence(
    command: Cli, arguments: list[str], said: str, code: int
) -> None:
    ran = command("change", *arguments)
    assert ran.code == code
    assert said in ran.err
    assert "Traceback" not in ran.err
    assert len(ran.err.strip().splitlines()) == 1


def test_a_folder_with_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="holds files that are no changes"):
        refuse_taken(tmp_path, overwrite=True)
    (tmp_path / "mine.txt").unlink()
    refuse_taken(tmp_path, overwrite=False)
    (tmp_path / "change.json").write_text("{}")
    with pytest.raises(InputError, match="give --overwrite"):
        refuse_taken(tmp_path, overwrite=False)
    refuse_taken(tmp_path, overwrite=True)


@pytest.mark.slow
def test_a_dive_compared_with_itself_has_no_changes_and_four_files(
    command: Cli, small_dive: Path, tmp_path: Path
) -> None:
    out = tmp_path / "change"
    ran = command("change", "--from", small_dive, "--to", small_dive, "--out", out, "--json")
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert found["patches"] == []
    assert {path.name for path in out.iterdir()} == {
        "change.tif", "change.csv", "change.json", "change.png",
    }  # fmt: skip
    assert json.loads((out / "change.json").read_text())["areas"]["lost"] == 0.0
