"""Where pixels are expected after a known motion."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.tracking.pose.matcher import WIDE_WIDTHS, expected_matches, is_wide

CAMERA = CameraModel(96, 72, 80.0, 80.0, 48.0, 36.0)


def pointmap(known: bool = True) -> Pointmap:
    rng = np.random.default_rng(3)
    made = Pointmap.unknown(CAMERA)
    if known:
        made.rho[:] = rng.uniform(0.4, 1.2, made.rho.shape)
        made.rho[:, ::3] = 0.0
    return made


def test_known_pixels_are_expected_where_the_pose_projects_them() -> None:
    T = Sim3(Rotation.from_rotvec([0.02, -0.1, 0.05]).as_matrix(), np.array([0.1, 0.0, -0.05]))
    made = pointmap()
    found = expected_matches(made, T, CAMERA)
    points = made.points()
    known = made.rho > 0.0
    assert np.allclose(found[known], CAMERA.project(T.apply(points[known])), atol=1e-3)
    assert np.isfinite(found).all()


def test_without_depths_a_turn_still_moves_every_pixel() -> None:
    T = Sim3(Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix(), np.zeros(3))
    found = expected_matches(pointmap(known=False), T, CAMERA)
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    assert np.allclose(found, CAMERA.project(T.apply(rays)), atol=1e-3)


def test_a_step_is_wide_by_how_far_the_picture_shifts() -> None:
    still = Sim3.identity()
    wide = np.arctan(1.5 * WIDE_WIDTHS * CAMERA.width / CAMERA.fx)
    for angle, expected in ((0.3 * wide, False), (wide, True), (np.pi, False)):
        T = Sim3(Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix(), np.zeros(3))
        assert is_wide(pointmap(), still, T, CAMERA) is expected
