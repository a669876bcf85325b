"""Batches of similarities do what single ones do; their Jacobians against finite differences."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.similarity import Sim3, Sim3Batch, right_jacobian_inverse

Array = npt.NDArray[np.float64]
COUNT = 40


def tangents(angle: float, seed: int = 0) -> Array:
    """[COUNT, 7] of metres in translation, up to ``angle`` in rotation and log-scale."""
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=(COUNT, 7))
    xi[:, 3:6] *= angle / np.linalg.norm(xi[:, 3:6], axis=1)[:, None]
    xi[:, 6] = rng.uniform(-1.0, 1.0, COUNT) * min(angle, 1.0)
    return xi


def as_matrices(batch: Sim3Batch) -> Array:
    return np.stack([batch.element(i).matrix for i in range(len(batch))])


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.1, 1.0, 3.1])
def test_exp_and_log_agree_with_single_elements(angle: float) -> None:
    xi = tangents(angle)
    batch = Sim3Batch.exp(xi)
    single = np.stack([Sim3.exp(each).matrix for each in xi])
    np.testing.assert_allclose(as_matrices(batch), single, atol=1e-11)
    np.testing.assert_allclose(batch.log(), xi, atol=1e-9)


def test_products_and_inverses_agree_with_matrices() -> None:
    a, b = Sim3Batch.exp(tangents(1.0)), Sim3Batch.exp(tangents(2.0, seed=1))
    np.testing.assert_allclose(as_matrices(a @ b), as_matrices(a) @ as_matrices(b), atol=1e-12)
    np.testing.assert_allclose(as_matrices(a.inverse()), np.linalg.inv(as_matrices(a)), atol=1e-12)


def test_one_element_goes_with_every_other() -> None:
    one, many = Sim3Batch.exp(tangents(1.0)[:1]), Sim3Batch.exp(tangents(2.0))
    np.testing.assert_allclose(
        as_matrices(one @ many), as_matrices(one)[0] @ as_matrices(many), atol=1e-12
    )


def test_the_adjoint_carries_a_tangent_through() -> None:
    T, xi = Sim3Batch.exp(tangents(1.5)), tangents(0.7, seed=2)
    carried = (T.adjoint() @ xi[:, :, None])[:, :, 0]
    np.testing.assert_allclose(
        as_matrices(T @ Sim3Batch.exp(xi)), as_matrices(Sim3Batch.exp(carried) @ T), atol=1e-9
    )


@pytest.mark.parametrize(("angle", "error"), [(1e-3, 1e-8), (0.5, 1e-8), (1.0, 1e-8), (2.5, 2e-3)])
def test_the_right_jacobian_inverse_is_the_derivative_of_log(angle: float, error: float) -> None:
    xi, step = tangents(angle), 1e-5
    J = right_jacobian_inverse(xi)
    for column in range(7):
        d = np.zeros((COUNT, 7))
        d[:, column] = step
        ahead = (Sim3Batch.exp(xi) @ Sim3Batch.exp(d)).log()
        behind = (Sim3Batch.exp(xi) @ Sim3Batch.exp(-d)).log()
        np.testing.assert_allclose(
            J[:, :, column], (ahead - behind) / (2 * step), rtol=error, atol=error
        )


def test_elements_put_back_on_the_group_have_orthonormal_rotations() -> None:
    T = Sim3Batch.exp(tangents(1.0))
    bent = Sim3Batch(T.R + 1e-6, T.t, T.scale).on_group()
    np.testing.assert_allclose(
        bent.R @ bent.R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (COUNT, 3, 3)), atol=1e-12
    )
