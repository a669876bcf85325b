"""Who reads a dive that is not finished: one sentence on what happened, and what to do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.storage.dive_status import (
    DiveState,
    DiveStatus,
    read_status,
    refuse_without_map,
    rescaling,
    unfinished_reason,
)
from aquaflow.base.storage.whole_folder import FolderLock

LIVE = DiveStatus(DiveState.OPEN, boot="boot")


def dive_in(folder: Path, status: DiveStatus | None, metrics: object = None) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "frames.csv").write_text("index\n")
    if metrics is not None:
        (folder / "metrics.json").write_text(json.dumps(metrics))
    if status is not None:
        status.write(folder)
    return folder


@pytest.mark.parametrize("state", [DiveState.FINISHED, DiveState.STOPPED])
def test_a_finished_dive_and_a_folder_that_is_no_dive_are_not_spoken_of(
    tmp_path: Path, state: DiveState
) -> None:
    assert unfinished_reason(tmp_path) is None
    assert unfinished_reason(dive_in(tmp_path, DiveStatus(state), {"complete": True})) is None


def test_a_replay_that_was_cut_off_is_to_be_mapped_again(tmp_path: Path) -> None:
    dive = dive_in(tmp_path, DiveStatus(DiveState.OPEN), {"complete": True})
    said = unfinished_reason(dive) or ""
    assert f"{dive} is not finished" in said
    assert f"`aquaflow map RECORDING --out {dive}`" in said
    with pytest.raises(InputError, match="is not finished"):
        refuse_without_map(dive)


@pytest.mark.parametrize("state", [DiveState.OPEN, DiveState.FINISHING])
def test_a_live_dive_with_a_checkpoint_is_to_be_finished(tmp_path: Path, state: DiveState) -> None:
    dive = dive_in(tmp_path, DiveStatus(state, boot="boot"))
    assert "before its first checkpoint" in (unfinished_reason(dive) or "")
    (dive / "checkpoint").mkdir()
    (dive / "checkpoint" / "state.npz").touch()
    assert f"`aquaflow run finish {dive}` does the rest" in (unfinished_reason(dive) or "")


def test_a_dive_that_a_process_writes_to_is_to_be_waited_for(tmp_path: Path) -> None:
    dive = dive_in(tmp_path, LIVE)
    lock = FolderLock(dive)
    assert "is being written by a running aquaflow" in (unfinished_reason(dive) or "")
    lock.release()
    assert "is being written" not in (unfinished_reason(dive) or "")


def test_without_a_status_the_metrics_tell(tmp_path: Path) -> None:
    assert "is not finished" in (unfinished_reason(dive_in(tmp_path, None)) or "")
    assert "is not finished" in (
        unfinished_reason(dive_in(tmp_path, None, {"complete": False})) or ""
    )
    assert unfinished_reason(dive_in(tmp_path, None, {"psnr": 20.0})) is None


def test_a_dive_of_which_nothing_could_be_mapped_says_that(tmp_path: Path) -> None:
    said = unfinished_reason(dive_in(tmp_path, DiveStatus(DiveState.FINISHED, boot="boot"))) or ""
    assert said.startswith(f"nothing of {tmp_path} could be mapped")


def test_a_change_of_unit_that_was_cut_off_is_told_and_one_that_ended_is_not(
    tmp_path: Path,
) -> None:
    before = DiveStatus(DiveState.STOPPED, boot="boot", begun_utc="2026-01-01T00:00:00Z")
    dive = dive_in(tmp_path, before, {})
    with rescaling(dive):
        assert "contradict each other" in (unfinished_reason(dive) or "")
    assert read_status(dive) == before
    with pytest.raises(KeyError), rescaling(dive):
        raise KeyError
    assert "contradict each other" in (unfinished_reason(dive) or "")
