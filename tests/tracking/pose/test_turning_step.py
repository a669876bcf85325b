"""A step into what has no depth yet: rotation and direction from matches, length from elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.tracking.wide_steps import turning_step
from tests.tracking.tracking_scenes import CAMERA, KnownPair, KnownView, SeaFloor, pose

STEP = pose((0.02, 0.2, 0.01), (0.3, 0.02, 0.05))
"""T_wc of the second view; the first is at the origin."""
FLOOR = SeaFloor()


def seen(T_wc: Sim3 = STEP, noise_px: float = 0.1) -> tuple[Pointmap, KnownPair]:
    """A pointmap without any depth, and its exact matches with the view at ``T_wc``."""
    here = Sim3.identity()
    a, b = (KnownView(CAMERA, T, FLOOR.depth(T)) for T in (here, T_wc))
    return Pointmap.unknown(CAMERA), KnownPair(a, b, noise_px, CAMERA)


def known_left(pointmap: Pointmap, columns: int, factor: float = 1.0) -> np.ndarray:
    """True depths, times ``factor``, in the leftmost columns; where they are."""
    known = np.zeros(pointmap.rho.shape, bool)
    known[:, :columns] = True
    pointmap.rho[known] = 1.0 / (factor * FLOOR.depth(Sim3.identity())[known])
    return known


def error(found: Sim3 | None, truth: Sim3) -> tuple[float, float]:
    """Degrees of the rotation, share of the translation."""
    assert found is not None
    off = found.R @ truth.R.T
    angle = np.degrees(np.arccos(np.clip((np.trace(off) - 1.0) / 2.0, -1.0, 1.0)))
    return angle, float(np.linalg.norm(found.t - truth.t) / np.linalg.norm(truth.t))


def test_the_length_of_the_step_comes_from_the_few_points_that_are_known() -> None:
    pointmap, pair = seen()
    columns = int(np.flatnonzero(pair.valid.any(axis=0))[0]) + 12
    known = known_left(pointmap, columns)
    assert (known & pair.valid).mean() < 0.08
    truth = STEP.inverse()
    predicted = Sim3(truth.R, 1.7 * truth.t)
    angle, off = error(turning_step(pointmap, pair, known, CAMERA, predicted), truth)
    assert angle < 0.2
    assert off < 0.05


def test_without_a_known_point_the_step_is_as_long_as_the_one_before() -> None:
    pointmap, pair = seen()
    truth, nothing = STEP.inverse(), np.zeros(pointmap.rho.shape, bool)
    found = turning_step(pointmap, pair, nothing, CAMERA, truth)
    assert found is not None
    assert np.linalg.norm(found.t) == pytest.approx(np.linalg.norm(truth.t))
    assert error(found, truth)[1] < 0.05


def test_without_any_length_there_is_no_step() -> None:
    pointmap, pair = seen()
    nothing = np.zeros(pointmap.rho.shape, bool)
    assert turning_step(pointmap, pair, nothing, CAMERA, Sim3.identity()) is None


def test_known_points_that_ask_for_a_step_of_another_size_refuse_it() -> None:
    pointmap, pair = seen()
    columns = int(np.flatnonzero(pair.valid.any(axis=0))[0]) + 12
    known = known_left(pointmap, columns, factor=5.0)
    assert turning_step(pointmap, pair, known, CAMERA, STEP.inverse()) is None


def test_a_pure_turn_gives_no_depth() -> None:
    turn = pose((0.0, 0.2, 0.0), (0.0, 0.0, 0.0))
    pointmap, pair = seen(turn)
    nothing = np.zeros(pointmap.rho.shape, bool)
    assert turning_step(pointmap, pair, nothing, CAMERA, STEP.inverse()) is None


def test_matches_that_agree_on_no_pose_give_none() -> None:
    pointmap, pair = seen()
    rng = np.random.default_rng(0)
    pair.matches = rng.uniform((0, 0), (240, 180), pair.matches.shape).astype(np.float32)
    nothing = np.zeros(pointmap.rho.shape, bool)
    assert turning_step(pointmap, pair, nothing, CAMERA, STEP.inverse()) is None


def test_too_few_matches_give_none() -> None:
    pointmap, pair = seen()
    pair.valid = np.zeros_like(pair.valid)
    pair.valid[:3, :10] = True
    nothing = np.zeros(pointmap.rho.shape, bool)
    assert turning_step(pointmap, pair, nothing, CAMERA, STEP.inverse()) is None
