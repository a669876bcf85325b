"""A recording replayed: what is mapped, what is held out, what repeats, and what a loss costs."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors import InputError, NotMappedError
from aquaflow.base.storage.dive_status import refuse_unfinished
from aquaflow.config import Config, SourceConfig
from aquaflow.dive.replay import map_recording
from aquaflow.recordings.synthetic import SyntheticDive
from aquaflow.slam import Slam
from aquaflow.sources import open_recording
from aquaflow.sources.preprocessing import Preparation
from aquaflow.types import Frame
from tests.command_line import Cli
from tests.small_recording import FRAMES, HASTY, HEIGHT, QUICK, WIDTH

TRACKING_ONLY = Config.model_validate({"mapping": {"enabled": False}})


def rows(dive: Path) -> list[dict[str, str]]:
    with (dive / "frames.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_held_out_frames_are_tracked_and_never_mapped(small_recording: Path) -> None:
    few = dict.fromkeys(("refine_steps", "steps_keyframe", "steps_mapping", "steps_common"), 1)
    config = Config.model_validate({"source": {"width": 96}, "mapping": {"optimiser": few}})
    recording = open_recording(small_recording)
    prepare, slam = Preparation(config.source, recording.camera), Slam(config)
    tracked = []
    for frame in recording.frames():
        assert isinstance(frame, Frame)
        tracked += slam.process(prepare(frame))
    tracked += slam.finish()

    held_out = [view.frame_index for view in slam.held_out[0]]
    assert held_out == [i for i in range(FRAMES) if i % 8 == 0 and i != 0]
    assert {t.frame.index for t in tracked if t.T_wc is not None} >= set(held_out)
    mapped = [view.frame_index for view in slam.mappers[0].views]
    assert sorted(mapped + held_out) == list(range(FRAMES))


@pytest.mark.usefixtures("contained")
def test_a_mounting_that_cannot_be_read_costs_itself(
    small_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: SyntheticDive) -> None:
        raise InputError("planted")

    monkeypatch.setattr(SyntheticDive, "stated_mounting", fail)
    config = TRACKING_ONLY.model_copy(update={"source": SourceConfig(stop=8)})
    finished = map_recording(open_recording(small_recording), "x", tmp_path / "dive", config)
    assert [each["stage"] for each in finished.metrics["failures"]] == ["camera mounting"]
    assert (tmp_path / "dive" / "trajectory.tum").exists()


def test_holding_out_counts_the_frames_that_are_used(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    dive = tmp_path / "dive"
    chosen = ("--every", 2, "--start", 4)
    assert aquaflow("map", small_recording, *chosen, "--out", dive, *HASTY).code == 0
    assert [row["index"] for row in rows(dive)] == [str(i) for i in range(4, FRAMES, 2)]
    # The ninth used frame, and its time still counts from the recording's first frame.
    assert [path.name for path in (dive / "heldout").glob("*_real.png")] == ["000020_real.png"]
    assert rows(dive)[0]["t_s"] == "0.400000000"


def test_same_seed_and_clip_give_the_same_bytes(
    aquaflow: Cli, small_recording: Path, small_dive: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again"
    assert aquaflow("map", small_recording, "--out", again, *QUICK).code == 0
    for name in ("trajectory.tum", "map.ply", "map_clear.ply", "medium.json", "frames.csv"):
        assert (again / name).read_bytes() == (small_dive / name).read_bytes(), name


@pytest.mark.slow
def test_another_seed_gives_another_map(
    aquaflow: Cli, small_recording: Path, small_dive: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    assert aquaflow("map", small_recording, "--seed", 1, "--out", other, *QUICK).code == 0
    assert (other / "map.ply").read_bytes() != (small_dive / "map.ply").read_bytes()


def test_black_frames_in_the_middle_cost_those_frames_and_are_noted(
    aquaflow: Cli, small_recording: Path, tmp_path: Path
) -> None:
    source, dive = tmp_path / "blinded", tmp_path / "dive"
    shutil.copytree(small_recording, source)
    blind = range(9, 15)
    for i in blind:
        cv2.imwrite(str(source / "images" / f"{i:06d}.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    ran = aquaflow("map", source, "--out", dive, *HASTY)
    assert ran.code == 0
    table = rows(dive)
    assert [int(row["index"]) for row in table] == list(range(FRAMES))
    assert all(not table[i]["sub_map"] and table[i]["reason"] for i in blind)
    seeing = [row for i, row in enumerate(table) if i not in blind]
    assert sum(bool(row["sub_map"]) for row in seeing) >= 0.8 * len(seeing)
    assert any(row["sub_map"] for row in table[15:])
    numbers = json.loads((dive / "metrics.json").read_text())
    unposed = numbers["frames"] - numbers["tracked"]
    assert numbers["skipped_by"] == {"dark": 5}  # then tracking is asked, and is lost
    assert f"{unposed} of {FRAMES} frames got no pose" in ran.out
    assert f"{unposed} of {FRAMES} frames got no pose" in (dive / "report.html").read_text()


def test_progress_reaches_the_number_of_frames(small_recording: Path, tmp_path: Path) -> None:
    seen: list[tuple[str, int, int | None]] = []
    map_recording(
        open_recording(small_recording),
        "small",
        tmp_path / "dive",
        TRACKING_ONLY,
        progress=lambda *step: seen.append(step),
    )
    assert [step for step in seen if step[0] == "map"][-1] == ("map", FRAMES, FRAMES)
    whole = [(done_s, all_s) for stage, done_s, all_s in seen if stage == "whole"]
    assert len(whole) == FRAMES
    assert all(all_s is not None and done_s <= all_s for done_s, all_s in whole)


def test_a_still_camera_gives_no_map_and_says_what_is_needed(
    small_recording: Path, tmp_path: Path
) -> None:
    source = tmp_path / "still"
    source.mkdir()
    for i in range(8):
        shutil.copy(small_recording / "images" / "000000.png", source / f"{i}.png")
    with pytest.raises(NotMappedError, match="nothing moves"):
        map_recording(open_recording(source), "still", tmp_path / "dive", TRACKING_ONLY)
    assert all(row["reason"] for row in rows(tmp_path / "dive"))
    with pytest.raises(InputError, match="is not finished: mapping it was cut off, or failed"):
        refuse_unfinished(tmp_path / "dive")


def test_a_real_reef_is_tracked_from_small_pictures(
    aquaflow: Cli, shared_data: Path, tmp_path: Path
) -> None:
    clip, dive = shared_data / "reef_clip", tmp_path / "dive"
    options = ("--every", 6, "--width", 320, "--tracking-only", "--out", dive)
    calibration = ("--calib", clip / "camera.yaml")
    ran = aquaflow("map", clip / "reef_clip.mp4", *calibration, *options)
    assert ran.code == 0, ran.err
    result = json.loads(
        aquaflow("lab", "evaluate", dive, "--truth", clip / "poses_sfm.tum", "--json").out
    )
    assert result["posed_fraction"] > 0.9
    assert result["ate_pct_sim3"] < 1.0


def test_a_real_survey_of_eight_stills_is_placed(
    aquaflow: Cli, shared_data: Path, tmp_path: Path
) -> None:
    survey, dive = shared_data / "auv_survey_1", tmp_path / "dive"
    ran = aquaflow("map", survey, "--tracking-only", "--out", dive)
    assert ran.code == 0, ran.err
    truth = survey / "positions_geotiff.csv"
    result = json.loads(aquaflow("lab", "evaluate", dive, "--truth", truth, "--json").out)
    assert (result["posed"], result["frames"], result["left_out"]) == (8, 8, 0)
    assert result["ate_pct_sim3"] <= 3.0
