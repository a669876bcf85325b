"""The frame of a sub-map in the world: poses, what is known, and the sigma of points."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.world_frame import WorldFrame
from tests.metric_scenes import SCALE, SHIFT, TURN, metric_frame

T_MC = Sim3(Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix(), np.array([0.5, -1.0, 2.0]), 1.25)


def test_an_unknown_frame_leaves_every_pose_as_it_is() -> None:
    frame = WorldFrame.unknown("the dive was level")
    assert frame.is_identity
    assert frame.pose(T_MC) is T_MC
    assert (frame.unit, frame.metric, frame.level, frame.georeferenced) == (
        "map units", False, False, False,
    )  # fmt: skip
    assert frame.scale_source.startswith("none: the dive was level; ")


def test_a_pose_in_n_is_rigid_and_sees_the_same_points_scaled() -> None:
    frame = metric_frame()
    T_nc = frame.pose(T_MC)
    assert T_nc.scale == 1.0
    np.testing.assert_allclose(T_nc.t, SCALE * TURN @ T_MC.t + SHIFT, atol=1e-12)
    point_c = np.array([0.3, -0.2, 1.7])  # in the map's unit, seen from the camera
    point_n = SCALE * TURN @ (T_MC.R @ point_c + T_MC.t) + SHIFT
    np.testing.assert_allclose(T_nc.apply(SCALE * point_c), point_n, atol=1e-12)


def test_points_have_a_place_on_earth_only_in_level_metres_with_true_north() -> None:
    assert metric_frame().georeferenced
    for change in (
        {"metric": False},
        {"level": False},
        {"origin": None},
        {"north": "magnetic north"},
    ):
        assert not metric_frame(**change).georeferenced


def test_the_sigma_of_a_point_is_that_of_many_drawn_frames() -> None:
    frame, point_m = metric_frame(), np.array([2.0, -1.0, 0.5])
    point_n = frame.T_nm.apply(point_m)
    draws = np.random.default_rng(0).normal(size=(4000, 7)) * np.sqrt(np.diag(frame.covariance))
    drawn = np.array([(Sim3.exp(xi) @ frame.T_nm).apply(point_m) for xi in draws])
    covariance = frame.position_covariance(point_n)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=0.08 * np.abs(covariance).max())
