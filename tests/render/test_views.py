"""Poses of views: the gradient on the group, and steps that stay on it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from aquaflow.geometry.similarity import Sim3, so3_exp, so3_log
from aquaflow.mapping.scene import show
from aquaflow.render.contract import Renderer
from aquaflow.render.reference import ReferenceRenderer
from aquaflow.render.views import BETAS, View, refine_pose
from tests.mapping.mapping_scenes import CAMERA, cloud, picture, pose, renderer, view_of

TRUE = pose((0.1, -0.05, 0.02), (0.02, -0.03, 0.05))
BLANK = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)


def loss_of(view: View, viewmat: torch.Tensor, draw: Renderer) -> torch.Tensor:
    """The picture weighed with waves; of few Gaussians, because swaps in depth are jumps."""
    parameters = {
        name: tensor.to(viewmat.dtype) for name, tensor in cloud(count=12).parameters.items()
    }
    image = show(parameters, None, None, draw, view, viewmat).image
    y, x, _ = torch.meshgrid(*(torch.arange(n) for n in image.shape), indexing="ij")
    return (image * torch.sin(0.2 * x + 0.3 * y).to(image.dtype)).mean()


def first_gradient(view: View, matrix: torch.Tensor) -> np.ndarray:
    """What refine_pose takes for the tangent gradient, from Adam's first moment."""
    refine_pose(view, matrix, rate=1e-4)
    return view.moments[0] / (1.0 - BETAS[0])


def test_the_view_matrix_takes_world_points_to_the_camera() -> None:
    view = view_of(BLANK, TRUE)
    points = np.random.default_rng(0).normal(size=(7, 3))
    V = view.viewmat().double().numpy()
    np.testing.assert_allclose(
        points @ V[:3, :3].T + V[:3, 3], TRUE.inverse().apply(points), atol=1e-6
    )


def test_the_target_is_the_picture_between_zero_and_one() -> None:
    image = np.arange(48 * 64 * 3, dtype=np.int64).reshape(48, 64, 3).astype(np.uint8)
    target = view_of(image).target()
    assert target.dtype == torch.float32
    np.testing.assert_allclose(target.numpy(), image / 255.0, atol=1e-7)


def test_the_tangent_gradient_is_that_of_finite_differences_through_the_renderer() -> None:
    view = view_of(BLANK, TRUE)
    leaf = view.viewmat().requires_grad_()
    (G,) = torch.autograd.grad(loss_of(view, leaf, renderer()), leaf)
    V, step = view.viewmat().double(), 2e-3
    wanted = []
    for axis in np.eye(6):
        sides = []
        for sign in (1.0, -1.0):
            moved = V.clone()
            R = torch.from_numpy(so3_exp(sign * step * axis[3:]))
            moved[:3] = R @ V[:3]
            moved[:3, 3] += sign * step * torch.from_numpy(axis[:3])
            sides.append(float(loss_of(view, moved, ReferenceRenderer())))
        wanted.append((sides[0] - sides[1]) / (2.0 * step))
    got = first_gradient(view, G)
    assert np.linalg.norm(got - wanted) < 0.05 * np.linalg.norm(wanted)


def test_the_first_step_goes_downhill_by_the_rate_on_every_axis() -> None:
    view, rng = view_of(BLANK, TRUE), np.random.default_rng(0)
    before = view.viewmat().double().numpy()
    g = first_gradient(view, torch.from_numpy(rng.normal(size=(4, 4))))
    after = view.viewmat().double().numpy()
    turn = so3_log(after[:3, :3] @ before[:3, :3].T)
    np.testing.assert_allclose(turn, -1e-4 * np.sign(g[3:]), atol=2e-6)
    moved = after[:3, 3] - so3_exp(turn) @ before[:3, 3]
    np.testing.assert_allclose(moved, -1e-4 * np.sign(g[:3]), atol=2e-6)


def test_repeated_steps_bring_a_disturbed_pose_back() -> None:
    scene = cloud()
    view = view_of(picture(scene, TRUE), pose((0.12, -0.04, 0.0), (0.03, -0.035, 0.06)))
    target, draw, errors = view.target(), renderer(), []
    for i in range(120):
        error = view.T_wc.inverse() @ TRUE
        errors.append(np.linalg.norm(error.t) + np.linalg.norm(so3_log(error.R)))
        leaf = view.viewmat().requires_grad_()
        shown = show(scene.parameters, None, None, draw, view, leaf)
        (G,) = torch.autograd.grad((shown.image - target).abs().mean(), leaf)
        refine_pose(view, G, 2e-3 * 0.97**i)
    assert errors[-1] < 0.1 * errors[0]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_gradient_that_is_not_finite_leaves_pose_and_moments_alone(bad: float) -> None:
    view = view_of(BLANK, TRUE)
    G = torch.ones(4, 4)
    G[1, 2] = bad
    moments = view.moments
    refine_pose(view, G, rate=1e-2)
    assert view.T_wc is TRUE
    assert view.moments is moments


def test_no_gradient_means_no_movement() -> None:
    view = view_of(BLANK, TRUE)
    refine_pose(view, torch.zeros(4, 4), rate=1e-2)
    np.testing.assert_allclose(view.T_wc.R, TRUE.R, atol=1e-6)
    np.testing.assert_allclose(view.T_wc.t, TRUE.t, atol=1e-6)


def test_the_rotation_stays_a_rotation_and_the_scale_stays_after_a_thousand_steps() -> None:
    view = view_of(BLANK, Sim3(TRUE.R, TRUE.t, 1.7))
    rng = np.random.default_rng(3)
    for size in 10.0 ** rng.uniform(-20, 20, 1000):
        refine_pose(view, torch.from_numpy(size * rng.normal(size=(4, 4))).float(), rate=0.05)
    R = view.T_wc.R
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert view.T_wc.scale == 1.7
    assert np.linalg.norm(so3_log(R @ TRUE.R.T)) > 0.01
