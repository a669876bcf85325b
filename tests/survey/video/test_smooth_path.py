"""A camera's smooth way along the poses of a dive."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import Sim3
from aquaflow.survey.video.fly_through import smooth_path


def poses(jitter: float, count: int = 60) -> list[Sim3]:
    """Along x by 6 units and a turn of 90 degrees about z, with noise."""
    random = np.random.default_rng(0)
    found = []
    for share in np.linspace(0.0, 1.0, count):
        place = np.array([6.0 * share, 0.0, 0.0]) + jitter * random.standard_normal(3)
        turn = Rotation.from_euler("z", 90.0 * share, degrees=True)
        noise = Rotation.from_rotvec(jitter * random.standard_normal(3))
        found.append(Sim3((noise * turn).as_matrix(), place))
    return found


def roughness(path: list[Sim3]) -> float:
    """Mean second difference of the places."""
    places = np.array([pose.t for pose in path])
    return float(np.linalg.norm(np.diff(places, 2, axis=0), axis=1).mean())


def test_an_even_way_stays_as_it_is() -> None:
    path = smooth_path(poses(0.0), 100, 12)
    assert len(path) == 100
    places = np.array([pose.t for pose in path])
    np.testing.assert_allclose(places[:, 1:], 0.0, atol=1e-9)
    assert places[0, 0] == pytest.approx(0.0, abs=0.3)
    assert places[-1, 0] == pytest.approx(6.0, abs=0.3)
    assert (np.diff(places[:, 0]) > 0.0).all()
    for pose in path:
        angle = Rotation.from_matrix(pose.R).as_euler("zyx", degrees=True)
        assert angle[0] == pytest.approx(15.0 * pose.t[0], abs=1.0)


def test_jitter_is_taken_out_and_the_way_is_kept() -> None:
    path = smooth_path(poses(0.03), 60, 8)
    assert roughness(path) < 0.1 * roughness(poses(0.03))
    assert max(abs(float(pose.t[1])) for pose in path) < 0.05


def test_a_camera_that_turns_on_the_spot_turns_evenly() -> None:
    turning = [
        Sim3(Rotation.from_euler("y", angle, degrees=True).as_matrix(), np.zeros(3))
        for angle in (0.0, 0.0, 10.0, 80.0, 90.0)
    ]
    path = smooth_path(turning, 20, 4)
    angles = [np.degrees(Rotation.from_matrix(pose.R).magnitude()) for pose in path]
    assert (np.diff(angles) > 0.0).all()


@pytest.mark.parametrize("count", [1, 5])
def test_a_camera_that_never_moved_stands_still(count: int) -> None:
    path = smooth_path([Sim3.identity()] * count, 10, 4)
    assert len(path) == 10
    assert all((pose.t == 0.0).all() for pose in path)
