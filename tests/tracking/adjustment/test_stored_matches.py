"""Matches beyond the memory of an adjustment wait in a file: the same bits, no more memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aquaflow.tracking.adjustment import joint, stored_matches
from aquaflow.tracking.adjustment.equations import AnchorMatches
from aquaflow.tracking.adjustment.joint import JointProblem, adjust
from aquaflow.tracking.adjustment.stored_matches import MadeMatches, StoredMatches
from tests.tracking.adjustment.adjustment_scenes import Scene, no_links, scene, shaken


def in_a_folder(known: Scene, folder: Path | None) -> JointProblem:
    problem = known.problem(shaken(known.poses, 0.005))
    return JointProblem(
        problem.matches, problem.held_out, problem.links, problem.poses, problem.free, folder
    )


@pytest.mark.parametrize("room", [0, 20_000])
def test_an_adjustment_whose_matches_wait_in_a_file_finds_the_same_bits(
    room: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = scene(count=8, outliers=0.1)
    kept = adjust(in_a_folder(known, None), 10)
    monkeypatch.setattr(stored_matches, "MATCHES_BYTES", room)
    read = adjust(in_a_folder(known, tmp_path / "work"), 10)
    assert (kept.state.poses.t == read.state.poses.t).all()
    assert (kept.state.poses.R == read.state.poses.R).all()
    assert all((a == b).all() for a, b in zip(kept.state.rho, read.state.rho, strict=True))
    assert kept.verdict == read.verdict
    assert list((tmp_path / "work").iterdir()) == [], "the file has no name"


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_what_was_measured_comes_back_and_judgements_follow(
    kind: type, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_matches, "MATCHES_BYTES", 0)
    given = [in_precision(each, kind) for each in scene(count=4).matches]
    stored = StoredMatches.of(given, tmp_path)
    judged = stored.judged_as((2.0 * each.sigma, ~each.used) for each in stored)
    assert len(stored) == len(judged) == 4
    for before, after, changed in zip(given, stored, judged, strict=True):
        for name in ("anchor", "views", "rays", "rho", "variance", "at", "used", "sigma"):
            assert np.array_equal(getattr(after, name), getattr(before, name)), name
        assert after.at.dtype == kind
        assert (changed.used == ~before.used).all()
        assert (changed.sigma == 2.0 * before.sigma).all()


def in_precision(each: AnchorMatches, kind: type) -> AnchorMatches:
    at: Any = each.at.astype(kind)
    return AnchorMatches(
        each.anchor, each.views, each.rays, each.rho, each.variance, at, each.used, each.sigma
    )


def test_where_nothing_can_be_written_matches_stay_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(stored_matches, "MATCHES_BYTES", 0)
    (tmp_path / "work").write_text("a file where a folder should be")
    known = scene(count=4)
    stored = StoredMatches.of(known.matches, tmp_path / "work")
    assert all((a.at == b.at).all() for a, b in zip(stored, known.matches, strict=True))
    assert caplog.text.count("takes more memory") == 1


def test_what_waits_in_a_file_takes_no_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_matches, "MATCHES_BYTES", 0)
    monkeypatch.setattr(joint, "KEPT_BYTES", 0)
    one = scene(count=3).matches[1]
    measured = sum(getattr(one, name).nbytes for name in ("rays", "rho", "variance", "at"))

    def many(count: int) -> Iterator[AnchorMatches]:
        return (in_precision(one, np.float64) for _ in range(count))

    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    stored = StoredMatches.of(many(400), tmp_path)
    passed = sum(1 for each in stored if each.used.any())
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    assert passed == 400
    assert peak < 0.1 * 400 * measured + 1e6


def test_matches_that_are_made_anew_are_not_kept() -> None:
    known = scene(count=4)
    made: list[int] = []

    def make(number: int) -> AnchorMatches:
        made.append(number)
        return known.matches[number]

    matches = MadeMatches([partial(make, n) for n in range(4)])
    problem = known.problem(shaken(known.poses, 0.005))
    assert len(matches) == 4
    adjusted = adjust(
        JointProblem(matches, problem.held_out, no_links(), problem.poses, problem.free), 10
    )
    assert adjusted.better
    assert made == [0, 1, 2, 3, 0, 1, 2, 3], "once to adjust by, once to judge by"
