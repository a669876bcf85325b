"""Adjustments with known answers: poses, scales, outliers, the judge, and what is degenerate."""

from __future__ import annotations

import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.tracking.adjustment import joint as solver
from aquaflow.tracking.adjustment.equations import (
    AnchorEquations,
    AnchorMatches,
    anchor_equations,
)
from aquaflow.tracking.adjustment.joint import (
    System,
    adjust,
    covariance,
    linearise,
    triangulate,
    verdict,
)
from tests.tracking.adjustment.adjustment_scenes import NOISE, Array, apart, scene, shaken


def test_poses_and_units_come_back_from_exact_matches() -> None:
    known = scene(noise=0.0)
    adjusted = adjust(known.problem(shaken(known.poses, 0.01), relative_sigma=1e-4), 10)
    assert apart(adjusted.state.poses, known.poses).max() < 1e-4
    assert adjusted.better


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_estimated_and_poses_are_as_good_as_stated(seed: int) -> None:
    known = scene(noise=NOISE, seed=seed)
    problem = known.problem(shaken(known.poses, 0.01))
    adjusted = adjust(problem, 10)
    found = np.concatenate([each.sigma for each in adjusted.matches])
    assert 0.6 * NOISE < np.median(found) < 2.0 * NOISE
    spread = covariance(adjusted.matches, problem.links, adjusted.state, problem.free)
    true = Sim3Batch.of(known.poses)
    d = (true.inverse() @ adjusted.state.poses).log()[1:].ravel()
    assert d @ np.linalg.solve(spread, d) < 3.0 * len(d)
    assert adjusted.better


def test_outliers_are_left_out() -> None:
    known = scene(outliers=0.2)
    adjusted = adjust(known.problem(shaken(known.poses, 0.005)), 10)
    used = sum(int(each.used.sum()) for each in adjusted.matches)
    given = sum(int(each.used[:, np.arange(120) % 5 != 4].sum()) for each in known.matches)
    assert 0.7 * given < used < 0.9 * given
    assert apart(adjusted.state.poses, known.poses).max() < 0.01


def test_a_dive_too_long_to_keep_its_equations_is_adjusted_to_the_same_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = scene(count=8)
    problem = known.problem(shaken(known.poses, 0.005))
    made: list[int] = []

    def counted(matches: AnchorMatches, poses: Sim3Batch, rho: Array) -> AnchorEquations:
        made.append(matches.anchor)
        return anchor_equations(matches, poses, rho)

    monkeypatch.setattr(solver, "anchor_equations", counted)
    kept, first = adjust(problem, 10).state, len(made)
    monkeypatch.setattr(solver, "KEPT_BYTES", 0)
    anew, second = adjust(problem, 10).state, len(made) - first
    assert second > first
    assert (kept.poses.t == anew.poses.t).all()
    assert all((a == b).all() for a, b in zip(kept.rho, anew.rho, strict=True))


def test_equations_of_two_states_are_never_in_memory_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = scene(count=8)
    kept: list[weakref.ref[Array]] = []

    def watched(*arguments: Any) -> System:
        assert [gain for gain in kept if gain() is not None] == []
        system = linearise(*arguments)
        kept.extend(weakref.ref(part.gain) for part in system.parts)
        return system

    monkeypatch.setattr(solver, "linearise", watched)
    adjust(known.problem(shaken(known.poses, 0.005)), 10)
    assert len(kept) > 4 * len(known.poses)


def test_matches_in_single_precision_are_summed_in_double() -> None:
    known = scene(count=4)
    problem = known.problem(shaken(known.poses, 0.005))
    single = [replace(each, at=each.at.astype(np.float32)) for each in problem.matches]
    double = [replace(each, at=each.at.astype(np.float64)) for each in single]
    found = [adjust(replace(problem, matches=each), 10).state for each in (single, double)]
    assert (found[0].poses.t == found[1].poses.t).all()


def test_poses_that_are_right_already_are_kept_as_they_are() -> None:
    known = scene()
    adjusted = adjust(known.problem(known.poses), 10)
    assert not adjusted.better


def test_points_that_took_no_part_refuse_worse_poses() -> None:
    known = scene()
    judges = known.problem(known.poses).matches
    true, worse = Sim3Batch.of(known.poses), Sim3Batch.of(shaken(known.poses, 0.01))
    assert verdict(judges, true, worse).gain_sigmas < -5.0
    assert verdict(judges, worse, true).gain_sigmas > 5.0
    assert verdict(judges, true, true).gain_sigmas == 0.0


def test_without_enough_points_nothing_is_judged() -> None:
    known = scene(count=2)
    problem = known.problem(shaken(known.poses, 0.01))
    few = [replace(each, used=each.used & (np.arange(120) < 15)) for each in problem.matches]
    adjusted = adjust(replace(problem, matches=few), 10)
    assert adjusted.verdict.points < 20
    assert not adjusted.better


def test_depths_are_triangulated_whatever_the_pointmap_says() -> None:
    known = scene(noise=0.0)
    wrong = replace(known.matches[2], rho=5.0 * known.rho[2])
    seen = wrong.used.any(axis=0)
    found = triangulate(wrong, Sim3Batch.of(known.poses))
    np.testing.assert_allclose(found[seen], known.rho[2][seen], rtol=1e-6)


def test_two_keyframes_are_adjusted() -> None:
    known = scene(count=2)
    adjusted = adjust(known.problem(shaken(known.poses, 0.01)), 10)
    assert apart(adjusted.state.poses, known.poses).max() < 0.01


def test_a_camera_that_only_turns_stays_finite_and_keeps_its_unit() -> None:
    known = scene(step=0.0)
    still = [Sim3(T.R, np.zeros(3), T.scale) for T in known.poses]
    adjusted = adjust(scene_at(still).problem(still), 10)
    assert np.isfinite(adjusted.state.poses.t).all()
    np.testing.assert_allclose(adjusted.state.poses.scale, [T.scale for T in still], rtol=0.05)


def scene_at(poses: list[Sim3]):  # type: ignore[no-untyped-def]
    """The scene whose camera only turned: what it sees holds no depth."""
    known = scene(step=0.0)
    matches = []
    for each, T in zip(known.matches, poses, strict=True):
        at = each.at.copy()
        for v, j in enumerate(each.views):
            seen = (poses[j].inverse() @ T).apply(each.rays / known.rho[each.anchor][:, None])
            at[v] = seen[:, :2] / seen[:, 2:]
        matches.append(replace(each, at=at, sigma=np.full(len(each.views), NOISE)))
    known.poses, known.matches = poses, matches
    return known
