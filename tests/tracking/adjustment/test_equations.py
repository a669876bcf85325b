"""Derivatives against finite differences, and the elimination of the depths against solving all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.render.library import load_library
from aquaflow.tracking.adjustment.equations import (
    AnchorMatches,
    Links,
    anchor_equations,
    equations_and_scores,
    equations_by_definition,
    error_lengths,
    project,
)
from aquaflow.tracking.adjustment.joint import BlockPattern, BundleState, cost_of, linearise
from tests.tracking.adjustment.adjustment_scenes import Array, no_links, scene, shaken

STEP = 1e-6


def stretched(matches: AnchorMatches) -> AnchorMatches:
    """Huber's loss is a square everywhere: so is the model of the equations."""
    return replace(matches, sigma=np.full(len(matches.views), 1.0))


def test_the_gradient_is_that_of_the_cost_along_poses_and_depths() -> None:
    known = scene(count=4)
    poses = shaken(known.poses, 0.01)
    matches = [stretched(each) for each in known.problem(poses).matches]
    state = BundleState(Sim3Batch.of(poses), [1.02 * each.rho for each in matches])
    equations = [
        anchor_equations(each, state.poses, rho)
        for each, rho in zip(matches, state.rho, strict=True)
    ]
    rng = np.random.default_rng(5)
    step = rng.normal(0.0, 1.0, (4, 7))
    # The eliminated gradient is the slope along steps that take the best depths with them.
    slope = sum(
        float(part.gradient @ step[each.places].ravel())
        for each, part in zip(matches, equations, strict=True)
    )

    def cost_at(size: float) -> float:
        moved = state.poses @ Sim3Batch.exp(size * step)
        rho = [
            rho - size * part.gain @ step[each.places].ravel()
            for each, part, rho in zip(matches, equations, state.rho, strict=True)
        ]
        return cost_of(matches, no_links(), BundleState(moved, rho))

    # At depths that are not the best, -offset . g_p remains; it is the same at both ends.
    numeric = (cost_at(STEP) - cost_at(-STEP)) / (2 * STEP)
    assert numeric == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_residuals_move_as_their_derivatives_say(moved: int) -> None:
    known = scene(count=3, noise=0.0)
    matches = stretched(known.matches[1])
    poses, rho = Sim3Batch.of(shaken(known.poses, 0.01)), 1.01 * known.rho[1]
    rng = np.random.default_rng(moved)
    d = rng.normal(0.0, 1.0, 7)

    def errors(size: float) -> Array:
        steps = np.zeros((3, 7))
        steps[moved] = size * d
        return project(matches, poses @ Sim3Batch.exp(steps), rho).error

    slope = (errors(STEP) - errors(-STEP)) / (2 * STEP)
    at = list(matches.places).index(moved)
    exact = replace(matches, variance=np.full(len(rho), 1e-30))  # holds the depths
    part = anchor_equations(replace(exact, rho=rho), poses, rho)
    own = part.gradient[7 * at : 7 * at + 7]
    assert float((slope * errors(0.0)).sum()) == pytest.approx(float(own @ d), rel=1e-5)
    curvature = part.H[7 * at : 7 * at + 7, 7 * at : 7 * at + 7]
    assert float((slope**2).sum()) == pytest.approx(float(d @ curvature @ d), rel=1e-5)


def test_the_gradient_is_what_the_points_add_to_it() -> None:
    known = scene(count=4, noise=1e-3)
    matches, rho = known.matches[1], 1.01 * known.rho[1]
    part, scores = equations_and_scores(matches, Sim3Batch.of(known.poses), rho)
    assert scores.shape == (len(rho), 7 * len(matches.places))
    assert (scores.sum(axis=0) == part.gradient).all()
    assert np.abs(part.gradient).max() > 0.0


def test_links_pull_as_their_cost_says() -> None:
    poses = Sim3Batch.of(shaken(scene(count=3).poses, 0.02))
    rng = np.random.default_rng(2)
    root = rng.normal(size=(2, 7, 7))
    links = Links(
        np.array([1, 2]),
        np.array([0, 1]),
        Sim3Batch.of([Sim3.exp(rng.normal(0.0, 0.1, 7)) for _ in range(2)]),
        root @ root.transpose(0, 2, 1),
    )
    free = np.ones(3, dtype=bool)
    system = linearise([], links, BundleState(poses, []), BlockPattern.of([], links, free))
    H, gradient = system.H, system.gradient
    step = rng.normal(size=(3, 7))

    def cost_at(size: float) -> float:
        return links.cost(poses @ Sim3Batch.exp(size * step))

    numeric = (cost_at(STEP) - cost_at(-STEP)) / (2 * STEP)
    assert numeric == pytest.approx(float(gradient @ step.ravel()), rel=1e-5)
    assert np.abs((H - H.T).toarray()).max() < 1e-9
    assert np.linalg.eigvalsh(H.toarray()).min() > -1e-9


def test_poses_that_are_held_are_no_unknowns() -> None:
    known = scene(count=4)
    problem = known.problem(known.poses)
    state = BundleState(problem.poses, known.rho)
    free = np.array([False, True, False, True])
    pattern = BlockPattern.of(problem.matches, no_links(), free)
    system = linearise(problem.matches, no_links(), state, pattern)
    assert system.H.shape == (14, 14)
    assert system.gradient.shape == (14,)


def test_sums_of_blocks_are_those_of_a_dense_matrix() -> None:
    known = scene(count=6, reach=1)
    problem = known.problem(shaken(known.poses, 0.01))
    state, free = BundleState(problem.poses, known.rho), np.ones(6, dtype=bool)
    free[[0, 3]] = False
    H, gradient = np.zeros((42, 42)), np.zeros(42)
    for each, rho in zip(problem.matches, state.rho, strict=True):
        part = anchor_equations(each, state.poses, rho)
        at = (7 * each.places[:, None] + np.arange(7)).ravel()
        H[np.ix_(at, at)] += part.H
        gradient[at] += part.gradient
    pattern = BlockPattern.of(problem.matches, no_links(), free)
    system = linearise(problem.matches, no_links(), state, pattern)
    own = np.flatnonzero(np.repeat(free, 7))
    assert np.allclose(system.H.toarray(), H[np.ix_(own, own)], rtol=1e-12, atol=1e-9)
    assert np.allclose(system.gradient, gradient[own], rtol=1e-12, atol=1e-9)
    assert len(pattern.keys) < 16  # no point is seen by keyframes 1 and 5


def unlucky(seed: int) -> tuple[AnchorMatches, Sim3Batch, Array]:
    """Outliers, points that some or no views see or that are behind one, unknown depths."""
    known = scene(count=5, noise=1e-3)
    random = np.random.default_rng(seed)
    matches, rho = known.matches[1], known.rho[1] * random.lognormal(0.0, 0.3, len(known.rho[1]))
    used = matches.used & (random.random(matches.used.shape) < 0.8)
    used[:, :5] = False
    at = np.where(used[..., None], matches.at + 0.1 * (random.random(used.shape) < 0.1)[..., None],
                  np.nan)  # fmt: skip
    rho[5:9] = -3.0
    variance = np.where(random.random(len(rho)) < 0.3, np.inf, (0.1 * rho) ** 2)
    changed = replace(matches, used=used, at=at.astype(np.float32), variance=variance)
    return changed, Sim3Batch.of(shaken(known.poses, 0.02)), rho


@pytest.mark.parametrize("seed", range(3))
def test_compiled_equations_are_those_of_the_definition(seed: int) -> None:
    matches, poses, rho = unlucky(seed)
    load_library()
    (found, found_scores), (expected, scores) = (
        make(matches, poses, rho) for make in (equations_and_scores, equations_by_definition)
    )
    pairs = [(found_scores, scores)] + [
        (getattr(found, name), getattr(expected, name))
        for name in ("H", "gradient", "gain", "offset")
    ]
    for got, wanted in pairs:
        np.testing.assert_allclose(got, wanted, rtol=1e-8, atol=1e-10 * np.abs(wanted).max())
    errors = np.linalg.norm(project(matches, poses, rho).error, axis=-1)
    np.testing.assert_allclose(error_lengths(matches, poses, rho), errors, rtol=1e-9, atol=1e-14)


def test_an_anchor_that_no_view_sees_pulls_no_pose() -> None:
    matches, poses, rho = unlucky(0)
    blind = replace(matches, used=np.zeros_like(matches.used))
    part, scores = equations_and_scores(blind, poses, rho)
    assert not part.H.any()
    assert not part.gradient.any()
    assert not scores.any()
    assert np.isfinite(part.offset).all()
