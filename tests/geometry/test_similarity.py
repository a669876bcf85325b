"""Sim(3): the group axioms, exp and log at the edges of their domains, long products."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import (
    Sim3,
    hat,
    quaternion_from_rotation,
    rotation_from_quaternion,
    so3_exp,
    so3_log,
)

Array = npt.NDArray[np.float64]

SMALL_STEPS = 10_000

unit = st.floats(-1.0, 1.0)


@st.composite
def tangents(draw: st.DrawFn, largest_angle: float = 3.0) -> Array:
    """[7] any direction of rotation up to ``largest_angle``, scale within e^-3 to e^3."""
    u = np.array([draw(st.floats(-5.0, 5.0)) for _ in range(3)])
    axis = np.array([draw(unit) for _ in range(3)])
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])
    angle = draw(st.floats(0.0, largest_angle))
    return np.concatenate([u, angle * axis, [draw(st.floats(-3.0, 3.0))]])


elements = tangents().map(Sim3.exp)


def assert_same(a: Sim3, b: Sim3, tolerance: float = 1e-9) -> None:
    size = 1.0 + float(np.abs(a.t).max()) + a.scale
    np.testing.assert_allclose(a.R, b.R, atol=tolerance)
    np.testing.assert_allclose(a.t, b.t, atol=tolerance * size)
    np.testing.assert_allclose(a.scale, b.scale, rtol=tolerance)


def assert_rotation(R: Array, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=tolerance)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=tolerance)


def generator(xi: Array) -> Array:
    """[4, 4] whose matrix exponential the group element is."""
    G = np.zeros((4, 4))
    G[:3, :3] = hat(xi[3:6]) + xi[6] * np.eye(3)
    G[:3, 3] = xi[:3]
    return G


@given(elements, elements)
def test_a_product_is_a_similarity_again(a: Sim3, b: Sim3) -> None:
    product = a @ b
    assert_rotation(product.R)
    assert product.scale > 0.0
    assert product.is_finite()
    np.testing.assert_allclose(product.matrix, a.matrix @ b.matrix, rtol=1e-9, atol=1e-8)


@given(elements)
def test_the_identity_changes_nothing_from_either_side(a: Sim3) -> None:
    assert_same(a @ Sim3.identity(), a)
    assert_same(Sim3.identity() @ a, a)


@given(elements)
def test_the_inverse_undoes_from_either_side(a: Sim3) -> None:
    np.testing.assert_allclose((a @ a.inverse()).matrix, np.eye(4), atol=1e-8)
    np.testing.assert_allclose((a.inverse() @ a).matrix, np.eye(4), atol=1e-6)


@given(elements, elements, elements)
def test_products_are_associative(a: Sim3, b: Sim3, c: Sim3) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))


@given(elements, elements)
def test_applying_a_product_is_applying_one_after_the_other(a: Sim3, b: Sim3) -> None:
    points = np.random.default_rng(0).normal(size=(4, 5, 3))
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-7)


@given(elements)
def test_the_pose_in_the_unit_of_its_source_projects_every_point_to_the_same_place(
    a: Sim3,
) -> None:
    points = np.random.default_rng(0).normal(size=(5, 3))
    unscaled = a.in_source_unit()
    assert unscaled.scale == 1.0
    np.testing.assert_allclose(unscaled.apply(points) * a.scale, a.apply(points), atol=1e-7)


@given(tangents())
def test_exp_is_the_matrix_exponential_of_the_generator(xi: Array) -> None:
    expected = expm(generator(xi))
    np.testing.assert_allclose(
        Sim3.exp(xi).matrix, expected, atol=1e-11 * (1.0 + np.abs(expected).max())
    )


@given(tangents())
def test_log_undoes_exp(xi: Array) -> None:
    np.testing.assert_allclose(Sim3.exp(xi).log(), xi, atol=1e-8)


@pytest.mark.parametrize("sigma", [0.0, 1e-9, -1e-9, 8.0, -8.0])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-4, np.pi - 1e-7])
def test_exp_and_log_are_exact_at_the_edges(angle: float, sigma: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    xi = np.concatenate([[0.3, -0.7, 1.1], angle * axis, [sigma]])

    element = Sim3.exp(xi)

    expected = expm(generator(xi))
    np.testing.assert_allclose(
        element.matrix, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max()
    )
    np.testing.assert_allclose(Sim3.exp(element.log()).matrix, element.matrix, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(element.log(), xi, atol=1e-6)


def test_log_of_a_half_turn_has_the_angle_pi() -> None:
    w = np.array([0.0, np.pi, 0.0])
    found = so3_log(so3_exp(w))
    assert np.linalg.norm(found) == pytest.approx(np.pi)
    np.testing.assert_allclose(so3_exp(found), so3_exp(w), atol=1e-12)


def test_ten_thousand_small_steps_stay_on_the_group() -> None:
    rng = np.random.default_rng(1)
    step = Sim3.exp(np.concatenate([rng.normal(size=6) * 1e-3, [1e-5]]))
    product = Sim3.identity()
    for _ in range(SMALL_STEPS):
        product = step @ product

    assert_rotation(product.R, 1e-12)
    expected = expm(SMALL_STEPS * generator(step.log()))
    np.testing.assert_allclose(product.matrix, expected, atol=1e-8)


@given(tangents())
def test_hat_is_the_cross_product(xi: Array) -> None:
    x = np.array([[0.2, -1.0, 3.0], [1.0, 1.0, -4.0]])
    w = np.stack([xi[:3], xi[3:6]])
    np.testing.assert_allclose(np.einsum("nij,nj->ni", hat(w), x), np.cross(w, x), atol=1e-12)


@given(elements)
def test_quaternions_are_unit_wxyz_and_invert(a: Sim3) -> None:
    q = a.quaternion
    assert np.linalg.norm(q) == pytest.approx(1.0)
    assert q[0] >= 0.0
    np.testing.assert_allclose(rotation_from_quaternion(5.0 * q), a.R, atol=1e-9)
    np.testing.assert_allclose(quaternion_from_rotation(a.R[None])[0], q, atol=1e-12)


def test_quaternions_put_the_scalar_first() -> None:
    half = np.sqrt(0.5)
    quarter_turn_about_z = rotation_from_quaternion(np.array([half, 0.0, 0.0, half]))
    np.testing.assert_allclose(quarter_turn_about_z @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    "broken",
    [
        Sim3(np.full((3, 3), np.nan), np.zeros(3)),
        Sim3(np.eye(3), np.array([0.0, np.inf, 0.0])),
        Sim3(np.eye(3), np.zeros(3), float("nan")),
        Sim3(np.eye(3), np.zeros(3), 0.0),
        Sim3(np.eye(3), np.zeros(3), -1.0),
    ],
    ids=["rotation", "translation", "scale", "zero scale", "negative scale"],
)
def test_a_broken_similarity_says_so(broken: Sim3) -> None:
    assert not broken.is_finite()
    assert Sim3.identity().is_finite()


def test_a_product_holds_no_more_than_its_own_numbers() -> None:
    product = Sim3.identity() @ Sim3(so3_exp(np.array([0.1, 0.2, 0.3])), np.zeros(3), 2.0)
    assert product.R.base is None


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 1.0, np.pi, 6.0])
def test_a_rotation_vector_turns_as_scipy_has_it(angle: float) -> None:
    for axis in np.random.default_rng(2).normal(size=(8, 3)):
        w = angle * axis / np.linalg.norm(axis)
        expected = Rotation.from_rotvec(w).as_matrix()
        np.testing.assert_allclose(so3_exp(w), expected, atol=1e-15)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_a_rotation_vector_that_is_no_number_gives_none(bad: float) -> None:
    assert np.isnan(so3_exp(np.array([0.1, bad, 0.2]))).all()
