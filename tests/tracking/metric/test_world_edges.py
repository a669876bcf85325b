"""Edges from the world to keyframes: information only where something was measured."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import Sim3
from aquaflow.tracking.metric.measured import KeyframeMeasurements, World, WorldEdge, world_edge
from tests.metric_scenes import metric_frame

Array = npt.NDArray[np.float64]

T_NK = Sim3(Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([3.0, -2.0, 8.0]), 1.7)
CASES = {
    "depth": KeyframeMeasurements(depth_m=(8.5, 0.02)),
    "place": KeyframeMeasurements(place_m=(np.array([3.4, -2.2]), 0.3)),
    "down": KeyframeMeasurements(turn=np.array([0.01, -0.02, 9.0]), turn_sigma=(0.004, np.inf)),
    "down and north": KeyframeMeasurements(
        turn=np.array([0.01, -0.02, 0.03]), turn_sigma=(0.004, 0.05)
    ),
    "scale": KeyframeMeasurements(scale=(1.72, 0.01)),
}
RANKS = {"depth": 1, "place": 2, "down": 2, "down and north": 3, "scale": 1}


def made(measured: KeyframeMeasurements) -> WorldEdge:
    edge = world_edge(7, T_NK, measured)
    assert edge is not None
    assert edge.keyframe == 7
    return edge


def test_a_keyframe_of_which_nothing_was_measured_has_no_edge() -> None:
    assert world_edge(7, T_NK, KeyframeMeasurements()) is None


@pytest.mark.parametrize("name", CASES)
def test_there_is_information_in_as_many_directions_as_were_measured(name: str) -> None:
    edge = made(CASES[name])
    values = np.linalg.eigvalsh(edge.information)
    assert int((values > 1e-9 * values[-1]).sum()) == edge.count == RANKS[name]


def measurements(T: Sim3) -> dict[str, Array]:
    """What the instruments would measure at a pose."""
    turn = Rotation.from_matrix(T.R @ T_NK.R.T).as_rotvec()
    return {
        "depth": T.t[2:], "place": T.t[:2], "down": turn[:2], "down and north": turn,
        "scale": np.log([T.scale]),
    }  # fmt: skip


SIGMAS = {
    "depth": [0.02], "place": [0.3, 0.3], "down": [0.004, 0.004],
    "down and north": [0.004, 0.004, 0.05], "scale": [0.01],
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_information_is_that_of_what_the_instrument_sees_of_a_step(name: str) -> None:
    step, rows = 1e-6, []
    for k in range(7):
        xi = np.zeros(7)
        xi[k] = step
        ahead, behind = (measurements(T_NK @ Sim3.exp(x))[name] for x in (xi, -xi))
        rows.append((ahead - behind) / (2.0 * step))
    J = np.array(rows).T / np.array(SIGMAS[name])[:, None]
    np.testing.assert_allclose(made(CASES[name]).information, J.T @ J, rtol=1e-5, atol=1e-3)


def test_the_measured_pose_differs_only_in_what_was_measured() -> None:
    depth = made(CASES["depth"]).T_nk
    np.testing.assert_allclose(depth.t, [3.0, -2.0, 8.5])
    np.testing.assert_array_equal(depth.R, T_NK.R)
    assert depth.scale == T_NK.scale
    place = made(CASES["place"]).T_nk
    np.testing.assert_allclose(place.t, [3.4, -2.2, 8.0])
    down = made(CASES["down"]).T_nk
    turn = Rotation.from_matrix(down.R @ T_NK.R.T).as_rotvec()
    np.testing.assert_allclose(turn, [0.01, -0.02, 0.0], atol=1e-12)
    assert made(CASES["scale"]).T_nk.scale == 1.72
    np.testing.assert_array_equal(T_NK.t, [3.0, -2.0, 8.0])  # the argument stays as it is


@pytest.mark.parametrize(("name", "chi2"), [("depth", 25.0**2), ("place", 0.2 / 0.09)])
def test_the_strain_is_the_squared_difference_in_sigmas(name: str, chi2: float) -> None:
    edge = made(CASES[name])
    assert edge.chi2 == pytest.approx(chi2, rel=1e-6)


def test_a_world_lies_where_the_estimator_found_it_and_has_the_mean_strain() -> None:
    frame = metric_frame()
    edges = [made(CASES["depth"]), made(CASES["place"])]
    world = World.at(4, frame, edges)
    np.testing.assert_allclose((world.T_mn @ frame.T_nm).log(), 0.0, atol=1e-9)
    assert world.strain == pytest.approx((edges[0].chi2 + edges[1].chi2) / 3.0)
    assert World.at(4, frame, []).strain == 0.0
