"""Umeyama alignment: what it must recover, and what it must refuse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import Sim3

seeds = st.integers(0, 2**31)
scales = st.floats(1e-3, 1e3)
shifts = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


def cloud(seed: int, count: int = 12) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3))


def turn(seed: int) -> np.ndarray:
    return Rotation.random(random_state=seed).as_matrix()


@given(seeds, seeds, scales, shifts)
def test_recovers_any_similarity(seed, turn_seed, scale, shift):
    points = cloud(seed)
    truth = Sim3(turn(turn_seed), np.array(shift), scale)

    found = align(points, truth.apply(points), with_scale=True)

    np.testing.assert_allclose(found.T_target_source.scale, scale, rtol=1e-6)
    np.testing.assert_allclose(found.T_target_source.R, truth.R, atol=1e-6)
    np.testing.assert_allclose(
        found.T_target_source.apply(points), truth.apply(points), atol=1e-6 * (1 + scale)
    )
    assert not found.collinear


@given(seeds, seeds, shifts)
def test_recovers_any_rigid_motion(seed, turn_seed, shift):
    points = cloud(seed)
    truth = Sim3(turn(turn_seed), np.array(shift), 1.0)

    found = align(points, truth.apply(points), with_scale=False)

    assert found.T_target_source.scale == 1.0
    np.testing.assert_allclose(found.T_target_source.R, truth.R, atol=1e-6)


@given(seeds, seeds)
def test_result_is_a_rotation_even_for_mirrored_points(seed, other):
    assume(seed != other)
    points = cloud(seed)

    found = align(points, points * np.array([1.0, 1.0, -1.0]) + 0.1 * cloud(other), with_scale=True)

    np.testing.assert_allclose(np.linalg.det(found.T_target_source.R), 1.0, atol=1e-9)
    np.testing.assert_allclose(
        found.T_target_source.R @ found.T_target_source.R.T, np.eye(3), atol=1e-9
    )
    assert found.T_target_source.scale >= 0.0


@given(seeds)
def test_residual_is_no_larger_than_without_alignment(seed):
    rng = np.random.default_rng(seed)
    points, target = rng.normal(size=(2, 10, 3))

    rigid = align(points, target, with_scale=False)
    similar = align(points, target, with_scale=True)

    none_error = ((points - target) ** 2).sum()
    rigid_error = ((rigid.T_target_source.apply(points) - target) ** 2).sum()
    similar_error = ((similar.T_target_source.apply(points) - target) ** 2).sum()
    assert similar_error <= rigid_error + 1e-9
    assert rigid_error <= none_error + 1e-9


def test_points_on_a_plane_are_aligned_exactly():
    points = cloud(3) * np.array([1.0, 1.0, 0.0])
    truth = Sim3(turn(4), np.array([1.0, 2.0, 3.0]), 2.5)

    found = align(points, truth.apply(points), with_scale=True)

    np.testing.assert_allclose(found.T_target_source.R, truth.R, atol=1e-9)
    assert not found.collinear


def test_points_on_a_line_are_aligned_and_reported():
    points = np.linspace(0.0, 5.0, 8)[:, None] * np.array([1.0, 0.5, -0.2])
    truth = Sim3(turn(7), np.array([4.0, 0.0, 1.0]), 0.3)

    found = align(points, truth.apply(points), with_scale=True)

    assert found.collinear
    np.testing.assert_allclose(found.T_target_source.apply(points), truth.apply(points), atol=1e-9)


@pytest.mark.parametrize(
    ("source", "target", "sentence"),
    [
        (cloud(0, 2), cloud(1, 2), "at least 3 frames"),
        (cloud(0, 4), cloud(1, 5), r"both must be \[N, 3\]"),
        (np.ones((5, 3)), cloud(1, 5), "all 5 estimated positions are the same point"),
        (cloud(1, 5), np.ones((5, 3)), "all 5 true positions are the same point"),
        (np.full((5, 3), np.nan), cloud(1, 5), "not finite"),
    ],
)
def test_degenerate_input_is_refused_in_one_sentence(source, target, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        align(source, target, with_scale=True)
    assert "\n" not in str(caught.value)
