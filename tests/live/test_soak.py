"""A long live dive in short: what it keeps is bounded, and it gives back what it took."""

from __future__ import annotations

import itertools
import threading
from pathlib import Path

import pytest

from aquaflow.config.vehicle import VehicleConfig
from aquaflow.live.checkpoint.resume import resume_folder
from aquaflow.live.live_dive import LiveDive
from tests.live.live_scenes import ToldFeed, caught_up
from tests.live.soak import Rounds, Sample, Sampler, descriptors, soak, summary

MOST_VIEWS, MOST_HELD_OUT, ROUNDS = 2, 3, 2
FEW = {"steps_keyframe": 1, "steps_mapping": 1, "steps_common": 0, "refine_steps": 2}
SERVICE = {"mapping": {"steps_per_view": 0}, "health": {"enabled": False, "port": 8230}}
BOUNDED = VehicleConfig.model_validate(
    {
        "threads": 1,
        "mapping": {
            "optimiser": FEW | {"heldout_steps": 1},
            "medium": {"fit": False},
            "views_per_keyframe": MOST_VIEWS,
            "held_out_most": MOST_HELD_OUT,
        },
        "service": SERVICE,
    }
)


def test_views_files_threads_and_descriptors_of_a_live_dive_are_bounded(
    small_recording: Path, tmp_path: Path
) -> None:
    before = threading.active_count(), descriptors()
    with LiveDive(
        "soak", resume_folder(tmp_path / "dive", True), ToldFeed(), BOUNDED, True
    ) as dive:
        sampler = Sampler(dive, every=8, file=tmp_path / "soak.csv")
        for frame in itertools.islice(Rounds(small_recording, 0).pictures(), ROUNDS * 24):
            dive.parts.loop.take(frame)
            caught_up(dive)
            sampler.update(dive.parts.loop)
        dive.parts.checkpointer.take()
        caught_up(dive)
        sampler.update(dive.parts.loop)
    last = sampler.samples[-1]
    assert last.posed > 0.8 * ROUNDS * 24
    assert last.keyframes < last.views <= 2 * MOST_VIEWS * last.keyframes
    assert last.held_out == MOST_HELD_OUT
    assert len({sample.threads for sample in sampler.samples}) == 1
    assert len({sample.descriptors for sample in sampler.samples}) == 1
    assert (threading.active_count(), descriptors()) == before


def test_a_soak_of_any_length_takes_its_samples(small_recording: Path, tmp_path: Path) -> None:
    (tmp_path / "recording").symlink_to(small_recording)
    samples = soak(30, tmp_path, BOUNDED)
    assert [sample.frame for sample in samples] == list(range(1, 31))
    assert len((tmp_path / "soak.csv").read_text().splitlines()) == 31


def test_the_summary_compares_the_middle_with_the_end() -> None:
    samples = [
        Sample(10 * i, 1.0 * i, 1000 + i, 5, 20, i % 3, 2, 100, 8, 1, 30, 9 * i)
        for i in range(1, 101)
    ]
    found = summary(samples)
    assert found["rss_growth_percent"] == pytest.approx(100.0 * 45.5 / 1050.0, abs=1.0)
    assert found["bytes_per_frame"] == pytest.approx(102.4)
    assert found["most_waiting"] == 2


@pytest.mark.slow
def test_two_hours_leave_memory_threads_and_descriptors_as_they_were(tmp_path: Path) -> None:
    found = summary(soak(72_000, tmp_path))
    half, end = found["half"], found["end"]
    assert found["rss_growth_percent"] <= 5.0
    assert (end["threads"], end["descriptors"]) == (half["threads"], half["descriptors"])
