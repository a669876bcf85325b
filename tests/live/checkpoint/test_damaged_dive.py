"""Whatever happens to one file of a killed dive: it is gone on with, and what was lost is said."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.base.storage.archive import write_facts_file
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.frames_csv import read_rows
from aquaflow.live.checkpoint.generations import previous_file, read_state, state_file
from aquaflow.live.onboard import OnboardSettings, begin_dive
from aquaflow.types import Frame
from tests.command_line import Cli, refused
from tests.live.damaged_dives import Outcome, gone_on_with, killed_dive, many, readable
from tests.live.live_scenes import VEHICLE, ToldFeed

SAMPLED = 3


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Frame]]:
    """A dive that was killed, and its recording's frames; to be copied before use."""
    folder = tmp_path_factory.mktemp("killed")
    frames = killed_dive(folder)
    return folder / "dive", frames


@pytest.fixture
def dive(killed: tuple[Path, list[Frame]], tmp_path: Path) -> Path:
    """A copy of the killed dive."""
    return shutil.copytree(killed[0], tmp_path / "dive")


def nothing_more_was_lost(outcomes: list[Outcome]) -> None:
    assert [each for each in outcomes if each.problems] == []
    assert {each.went_on for each in outcomes} <= {"state", "previous"}


@pytest.mark.slow
def test_two_hundred_damages_cost_what_they_hit(killed: tuple[Path, list[Frame]]) -> None:
    outcomes = many(*killed, count=200, seed=0)
    nothing_more_was_lost(outcomes)
    assert {each.damage.kind for each in outcomes} == {"flip", "cut", "delete", "swap"}
    assert any(each.went_on == "previous" for each in outcomes)


def test_a_sample_of_damages_costs_what_it_hits(killed: tuple[Path, list[Frame]]) -> None:
    nothing_more_was_lost(many(*killed, count=SAMPLED, seed=1))


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0x10
    path.write_bytes(data)


def set_aside(dive: Path) -> set[str]:
    """Files in the folder of what was set aside."""
    folder = dive / "set-aside-1"
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


# --- checkpoints ----------------------------------------------------------------------------------


def test_the_older_checkpoint_stands_in_for_a_damaged_one(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    older, before = read_state(previous_file(dive)), readable(dive)
    flip(state_file(dive), 5000)
    finished, resumed = gone_on_with(dive, killed[1])
    assert resumed
    assert any("newest checkpoint was damaged or gone" in note for note in finished.notes)
    assert finished.metrics["tracked"] >= len(older.frames)
    assert before.things <= readable(dive).things
    kept = {"checkpoint/state.npz", "frames.csv", "trajectory.tum", "why.txt"}
    assert kept <= set_aside(dive)
    assert read_state(state_file(dive)).moment.wall_ns > older.moment.wall_ns


def test_a_damaged_older_checkpoint_is_set_aside_before_it_is_replaced(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    flip(previous_file(dive), 5000)
    finished, resumed = gone_on_with(dive, killed[1])
    assert resumed
    assert any("checkpoint before the newest one was damaged" in note for note in finished.notes)
    assert set_aside(dive) == {"checkpoint/previous.npz", "why.txt"}


def test_without_a_usable_checkpoint_the_recording_is_mapped_into_a_folder_beside(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    flip(state_file(dive), 5000)
    previous_file(dive).unlink()
    before = {path: path.read_bytes() for path in dive.rglob("*") if path.is_file()}
    finished, resumed = gone_on_with(dive, killed[1])
    assert not resumed
    assert finished.dive == dive.with_name("dive-2")
    assert any(f"{dive} holds a dive without a usable" in note for note in finished.notes)
    assert finished.metrics["tracked"] == len(killed[1])
    assert {path: path.read_bytes() for path in dive.rglob("*") if path.is_file()} == before


def test_a_start_after_that_goes_on_with_the_folder_beside(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    shutil.rmtree(dive / "checkpoint")
    gone_on_with(dive, killed[1][:12])
    finished, resumed = gone_on_with(dive, killed[1])
    assert resumed
    assert finished.dive == dive.with_name("dive-2")


def test_a_new_dive_never_goes_into_the_folder_of_another(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    rows = read_rows(dive / "frames.csv")
    finished, resumed = gone_on_with(dive, killed[1], new=True)
    assert not resumed
    assert finished.dive == dive.with_name("dive-2")
    assert any(f"{dive} holds another dive" in note for note in finished.notes)
    assert read_rows(dive / "frames.csv") == rows


def test_a_checkpoint_that_is_whole_and_fits_nothing_gives_way_to_the_older_one(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    shown = read_state(state_file(dive))
    del shown.arrays["tracking.poses"]
    write_facts_file(state_file(dive), shown.facts, shown.arrays)
    finished, resumed = gone_on_with(dive, killed[1])
    assert resumed
    assert finished.dive == dive
    assert "checkpoint/state.npz" in set_aside(dive)
    assert any("newest checkpoint was damaged or gone" in note for note in finished.notes)


def test_pictures_of_another_width_are_refused_before_anything_is_changed(dive: Path) -> None:
    before = {path: path.read_bytes() for path in dive.rglob("*") if path.is_file()}
    wider = VehicleConfig.model_validate(VEHICLE.model_dump() | {"source": {"width": 64}})
    with pytest.raises(ConfigError, match=r"begun with source.width the default .* with 64; give"):
        begin_dive(ToldFeed(), wider, OnboardSettings(dive))
    assert {path: path.read_bytes() for path in dive.rglob("*") if path.is_file()} == before


def test_map_refuses_another_width_in_one_sentence(
    killed: tuple[Path, list[Frame]], dive: Path, aquaflow: Cli
) -> None:
    recording = killed[0].with_name("recording")
    ran = aquaflow("map", recording, "--realtime", "--out", dive, "--width", 64)
    refused(ran, dive, "source.width the default", "with 64; give the same width")


# --- keyframes and views --------------------------------------------------------------------------


def test_a_dive_without_any_keyframe_file_keeps_its_poses(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    known = read_state(state_file(dive))
    shutil.rmtree(dive / "work" / "keyframes")
    finished, resumed = gone_on_with(dive, killed[1])
    assert resumed
    assert any("frames keep their poses" in note for note in finished.notes)
    assert finished.metrics["tracked"] >= int(
        (known.arrays["tracking.frames"]["keyframe"] >= 0).sum()
    )
    assert len((dive / "trajectory.tum").read_text().splitlines()) > finished.metrics["tracked"]


def test_a_map_without_any_view_keeps_its_gaussians(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    shutil.rmtree(dive / "work" / "views")
    finished, resumed = gone_on_with(dive, killed[1])
    assert resumed
    assert any("the map goes on without them" in note for note in finished.notes)
    assert finished.metrics["gaussians"] > 100


def test_what_was_lost_once_is_said_of_the_dive_and_not_lost_again(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    (dive / "work" / "keyframes" / "000001.arrays").unlink()
    first, _ = gone_on_with(dive, killed[1][:-1])
    second, _ = gone_on_with(dive, killed[1])
    said = [[note for note in each.notes if "keyframe 1" in note] for each in (first, second)]
    assert said[0] == said[1]
    assert len(said[0]) == 1


# --- rows -----------------------------------------------------------------------------------------


def test_rows_that_are_gone_are_made_from_the_checkpoint(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    before, known = read_rows(dive / "frames.csv"), read_state(state_file(dive)).frames
    (dive / "frames.csv").unlink()
    finished, _ = gone_on_with(dive, killed[1])
    after = {row.index: row for row in read_rows(dive / "frames.csv")}
    assert any("frames.csv was gone" in note for note in finished.notes)
    assert [after[row.index] for row in before if row.index in known] == [
        row for row in before if row.index in known
    ]


def test_a_row_whose_index_cannot_be_true_does_not_skip_the_rest_of_the_recording(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    text = (dive / "frames.csv").read_text()
    last = text.splitlines()[-1]
    (dive / "frames.csv").write_text(text.replace(last, "9" + last))
    finished, _ = gone_on_with(dive, killed[1])
    assert max(row.index for row in read_rows(dive / "frames.csv")) == killed[1][-1].index
    assert any("1 lines of frames.csv were damaged" in note for note in finished.notes)


CUT = '"}'


def is_json(line: str) -> bool:
    try:
        json.loads(line)
    except ValueError:
        return False
    return True


def test_the_log_goes_on_with_a_line_of_its_own(
    killed: tuple[Path, list[Frame]], dive: Path
) -> None:
    log = dive / "log.jsonl"
    whole = log.read_text().splitlines()
    log.write_text(log.read_text().removesuffix("\n").removesuffix(CUT))
    gone_on_with(dive, killed[1])
    lines = log.read_text().splitlines()
    assert [line for line in lines if not is_json(line)] == [whole[-1][: -len(CUT)]]
