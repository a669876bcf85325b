"""Two views: the pose on relief and on a plane, and parallax with the rotation taken out."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3, so3_exp, so3_log
from aquaflow.geometry.two_view import (
    MIN_MATCHES,
    pose_candidates,
    relative_pose,
    rotation_compensated_parallax_px,
)

Array = npt.NDArray[np.float64]

CAMERA = CameraModel(320, 240, 260.0, 260.0, 160.0, 120.0)
T_BA = Sim3(so3_exp(np.array([0.02, -0.05, 0.03])), np.array([-0.28, 0.04, 0.06]))
NOISE_PX = 0.2


def matches(
    T_ba: Sim3, relief: bool, count: int = 400, outliers: float = 0.0, seed: int = 0
) -> tuple[Array, Array]:
    """Pixels [M, 2] in both views, with noise."""
    rng = np.random.default_rng(seed)
    a = np.stack([rng.uniform(5, 315, count), rng.uniform(5, 235, count)], -1)
    rays = CAMERA.unproject(a)
    plane = 2.0 / (rays @ np.array([0.2, -0.3, 0.93]))
    depth = rng.uniform(1.2, 3.0, count) if relief else plane
    b = CAMERA.project(T_ba.apply(rays * depth[:, None])) + rng.normal(0, NOISE_PX, (count, 2))
    bad = rng.random(count) < outliers
    b[bad] = rng.uniform(0, 240, (int(bad.sum()), 2))
    return a, b


def pose_errors(found: Sim3, truth: Sim3) -> tuple[float, float]:
    """Degrees: rotation, direction of translation."""
    turn = np.degrees(np.linalg.norm(so3_log(found.R @ truth.R.T)))
    cosine = found.t @ truth.t / np.linalg.norm(found.t) / np.linalg.norm(truth.t)
    return float(turn), float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.5])
def test_the_pose_is_recovered_on_relief(outliers: float) -> None:
    found = relative_pose(*matches(T_BA, relief=True, outliers=outliers), CAMERA, CAMERA)
    assert found is not None
    turn, direction = pose_errors(found, T_BA)
    assert turn < 0.3
    assert direction < 2.0
    assert np.linalg.norm(found.t) == pytest.approx(1.0)


@pytest.mark.parametrize("outliers", [0.0, 0.1, 0.3, 0.5])
def test_the_pose_is_among_the_best_candidates_on_a_plane(outliers: float) -> None:
    """A plane leaves two poses that fit; both must be offered, the true one with full support."""
    candidates = pose_candidates(*matches(T_BA, relief=False, outliers=outliers), CAMERA, CAMERA)
    supports = [candidate.support for candidate in candidates]
    assert supports == sorted(supports, reverse=True)
    true = [c for c in candidates if max(pose_errors(c.T_ba, T_BA)) < 3.0]
    assert true
    assert max(c.support for c in true) > 0.9 * supports[0]
    assert "homography" in {c.source for c in true}


def test_too_few_matches_decide_nothing() -> None:
    a, b = matches(T_BA, relief=True, count=MIN_MATCHES - 1)
    assert pose_candidates(a, b, CAMERA, CAMERA) == []
    assert relative_pose(a, b, CAMERA, CAMERA) is None


def test_matches_without_parallax_give_no_supported_pose() -> None:
    a, _ = matches(T_BA, relief=True)
    assert relative_pose(a, a.copy(), CAMERA, CAMERA) is None


def test_one_point_repeated_raises_nothing() -> None:
    a = np.full((100, 2), 50.0)
    assert relative_pose(a, a + 3.0, CAMERA, CAMERA) is None


def test_random_matches_raise_nothing() -> None:
    rng = np.random.default_rng(0)
    for candidate in pose_candidates(
        rng.uniform(0, 240, (100, 2)), rng.uniform(0, 240, (100, 2)), CAMERA, CAMERA
    ):
        assert candidate.T_ba.is_finite()
        assert candidate.support < 0.5


def test_a_pure_rotation_leaves_no_parallax() -> None:
    turned = Sim3(so3_exp(np.array([0.1, -0.15, 0.3])), np.zeros(3))
    a, b = matches(turned, relief=True)
    assert np.median(np.linalg.norm(a - b, axis=1)) > 20.0
    assert rotation_compensated_parallax_px(a, b, CAMERA) < 2.0 * NOISE_PX


def test_a_translation_keeps_its_parallax_under_any_rotation() -> None:
    straight = Sim3(np.eye(3), np.array([0.0, 0.0, 0.5]))
    a, b = matches(straight, relief=True)
    plain = rotation_compensated_parallax_px(a, b, CAMERA)
    rolled = Sim3(so3_exp(np.array([0.0, 0.0, 0.4])), np.zeros(3)) @ straight
    _, c = matches(rolled, relief=True)
    assert plain > 5.0
    assert rotation_compensated_parallax_px(a, c, CAMERA) == pytest.approx(plain, rel=0.1)


def test_mirrored_matches_are_not_explained_by_a_reflection() -> None:
    a, _ = matches(T_BA, relief=True)
    mirrored = a * [-1.0, 1.0] + [CAMERA.width, 0.0]
    assert rotation_compensated_parallax_px(a, mirrored, CAMERA) > 20.0
