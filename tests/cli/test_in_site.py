"""``--in``: a site that is wrong, damaged or missing, and one in which a dive is recognised."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from aquaflow.base.errors.crash_report import MISUSED
from tests.command_line import Cli, refused
from tests.small_recording import HASTY


@pytest.mark.parametrize("command", ["map", "run --source"])
def test_a_site_that_is_not_there_is_refused_in_a_sentence(
    aquaflow: Cli, small_recording: Path, tmp_path: Path, command: str
) -> None:
    ran = aquaflow(*command.split(), small_recording, "--out", tmp_path / "out", "--in", "nowhere")
    refused(ran, "nowhere is no folder")
    assert not (tmp_path / "out").exists()


def test_a_folder_without_places_is_refused_in_a_sentence(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    (tmp_path / "site").mkdir()
    ran = aquaflow("map", small_recording, "--out", tmp_path / "out", "--in", tmp_path / "site")
    refused(ran, "places.npz")


def test_damaged_places_are_refused_in_a_sentence(
    aquaflow: Cli, small_recording: Path, small_dive: Path, tmp_path: Path
) -> None:
    site = Path(shutil.copytree(small_dive, tmp_path / "site"))
    whole = (site / "places.npz").read_bytes()
    (site / "places.npz").write_bytes(whole[: len(whole) // 2])
    ran = aquaflow("map", small_recording, "--out", tmp_path / "out", "--in", site)
    refused(ran, "cannot read")


def test_the_places_of_another_prior_are_refused_in_a_sentence(
    aquaflow: Cli, small_recording: Path, small_dive: Path, tmp_path: Path
) -> None:
    site = Path(shutil.copytree(small_dive, tmp_path / "site"))
    stated = json.loads((site / "metrics.json").read_text()) | {"prior": "another"}
    (site / "metrics.json").write_text(json.dumps(stated))
    ran = aquaflow("map", small_recording, "--out", tmp_path / "out", "--in", site)
    refused(ran, "described by the another prior")


def test_a_dive_is_never_written_over_the_one_that_it_is_looked_for_in(
    aquaflow: Cli, small_recording: Path, small_dive: Path
) -> None:
    ran = aquaflow("map", small_recording, "--out", small_dive, "--in", small_dive, "--overwrite")
    refused(ran, "are both", code=MISUSED)


def test_a_recognised_dive_says_in_whose_frame_it_is(
    aquaflow: Cli, small_recording: Path, small_dive: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    ran = aquaflow(
        "map", small_recording, "--out", out, "--in", small_dive, "--tracking-only", "--stop", 14,
        *HASTY,
    )  # fmt: skip
    assert ran.code == 0, ran.err
    found = json.loads((out / "in_site.json").read_text())
    assert found["state"] == "found"
    assert found["sub_maps"]["0"]["links"]
    assert f"of {small_dive.name}" in (out / "trajectory.tum").read_text().splitlines()[0]
    assert "was recognised in" in (out / "report.html").read_text()
