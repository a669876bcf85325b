"""The end of a dive within its time: by a clock on which every look at it costs a second."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.base.clocks.deadline import EVALUATED, REFINED, SETTLED, FinishTime
from aquaflow.config import Config, load_config
from aquaflow.dive.folder import DiveFolder
from aquaflow.dive.held_out import spread
from aquaflow.dive.ply import read_ply
from aquaflow.dive.run import DiveRun, Finished
from aquaflow.lab.evaluation.trajectory_error import read_tum
from aquaflow.slam import Slam
from aquaflow.sources import open_recording
from aquaflow.types import Frame

SECONDS = 30.0
FRAMES = 14


class Ticking:
    """Passes a second whenever it is looked at."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


@dataclass
class Ended:
    finished: Finished
    took_s: float
    steps: int
    """Of refining."""
    held_out: int
    """Views that there were."""


@pytest.fixture(scope="module")
def ended(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Ended:
    """A dive that would refine for ever, and whose held-out views are too many."""
    settings: dict[str, Any] = load_config(Path(__file__).parents[1] / "hasty.yaml").model_dump()
    settings["threads"], settings["source"]["width"] = 1, 96
    settings["mapping"]["optimiser"]["refine_steps"] = 100_000
    settings["mapping"]["hold_out_every"] = 2
    config = Config.model_validate(settings)
    recording = open_recording(small_recording)
    folder = DiveFolder(tmp_path_factory.mktemp("ended") / "dive", config)
    slam = Slam(config)
    run = DiveRun("ended", folder, config, slam, recording.camera, recording.name_of)
    for frame in recording.frames(stop=FRAMES):
        assert isinstance(frame, Frame)
        run.frame(frame)
    mapper, clock = slam.mappers[0], Ticking()
    before = mapper.steps
    finished = run.finish([], limits=FinishTime(SECONDS, clock))
    held_out = len(slam.held_out[0])
    folder.close()
    return Ended(finished, clock.now, mapper.steps - before, held_out)


def test_it_ends_within_its_time(ended: Ended) -> None:
    assert ended.took_s <= SECONDS


def test_refining_is_cut_where_its_phase_ends(ended: Ended) -> None:
    assert 0 < ended.steps <= REFINED * SECONDS


def test_only_some_held_out_views_are_evaluated_and_the_notes_say_so(ended: Ended) -> None:
    numbers = ended.finished.metrics
    assert 0 < numbers["heldout_frames"] < ended.held_out
    assert numbers["psnr"] is not None
    left = ended.held_out - numbers["heldout_frames"]
    said = [note for note in ended.finished.notes if "service.finish_s" in note]
    assert said[0].startswith(f"{left} of {ended.held_out} held-out views were not evaluated")


def test_the_ground_is_not_measured_without_time_and_the_file_says_so(ended: Ended) -> None:
    numbers = json.loads((ended.finished.dive / "reef_numbers.json").read_text())
    assert "no more time" in numbers["missing"]["ground"]
    assert "no metres" in numbers["missing"]["lengths and areas"]


def test_every_deliverable_is_there(ended: Ended) -> None:
    dive = ended.finished.dive
    assert len(read_ply(dive / "map.ply").means) > 0
    assert len(read_tum(dive / "trajectory.tum").positions) == ended.finished.metrics["tracked"]
    assert "held-out views were not evaluated" in (dive / "report.html").read_text()
    assert json.loads((dive / "metrics.json").read_text())["frames"] == FRAMES


def test_phases_end_one_after_the_other_and_without_a_limit_never() -> None:
    limits = FinishTime(SECONDS, lambda: 0.0)
    ends = [limits.settling, limits.refining, limits.evaluating, limits.whole]
    shares = [SETTLED, REFINED, EVALUATED, 1.0]
    assert [each.left_s for each in ends] == pytest.approx([share * SECONDS for share in shares])
    assert sorted(shares) == shares
    assert not FinishTime().whole.limited


@pytest.mark.parametrize("count", [0, 1, 2, 7, 64, 100])
def test_every_beginning_of_the_order_is_spread_over_the_dive(count: int) -> None:
    order = spread(count)
    assert sorted(order) == list(range(count))
    for some in range(3, count + 1):
        gaps = np.diff(sorted([-1, *order[:some], count]))
        assert gaps.max() <= 4.0 * count / some


def test_once_the_service_is_told_to_stop_every_phase_ends_so_much_later_at_most() -> None:
    now, told = [0.0], [False]
    limits = FinishTime(100.0, lambda: now[0], lambda: told[0], stop_s=10.0)
    part = limits.refining.share(0.5)
    assert limits.settling.left_s == pytest.approx(25.0)
    now[0], told[0] = 20.0, True
    assert limits.settling.left_s == pytest.approx(SETTLED * 10.0)
    assert limits.evaluating.left_s == pytest.approx(EVALUATED * 10.0)
    assert part.left_s == pytest.approx(REFINED * 10.0)  # also what was derived before
    now[0] = 26.0
    assert limits.refining.over
    assert not limits.evaluating.over
    now[0] = 30.0
    assert limits.whole.over
