"""The path and the ground of a sub-map, out of tables of keyframes and frames."""

from __future__ import annotations

import inspect

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.config import FusionConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.tracking.frame_table import FRAME, NONE
from aquaflow.tracking.graph.table import NODE
from aquaflow.tracking.metric.straightening import MOST_POINTS, TrackingSnapshot

Array = npt.NDArray[np.float64]

POSES = [
    Sim3(Rotation.from_rotvec([0.1 * k, 0.2, -0.1 * k]).as_matrix(), np.array([k, 0.5, 0.1 * k]),
         1.0 + 0.1 * k)
    for k in range(4)
]  # fmt: skip
STEP = Sim3(Rotation.from_rotvec([0.0, 0.05, 0.0]).as_matrix(), np.array([0.1, 0.0, 0.02]))


def survey(frames: Array, points: tuple[Array, ...] = ()) -> TrackingSnapshot:
    """Keyframes 0, 1, 2 of one sub-map and 3 of another."""
    nodes = np.zeros(4, NODE)
    for k, T in enumerate(POSES):
        nodes[k] = (k, 3 if k == 3 else 0, T.R, T.t, T.scale)
    values = {
        "nodes": nodes, "parts": (frames,), "telemetry": Telemetry(), "points": points,
        "mounting": None, "config": FusionConfig(),
    }  # fmt: skip
    fields = inspect.signature(TrackingSnapshot).parameters
    return TrackingSnapshot(**values, **{name: () for name in fields if name not in values})


def rows(*entries: tuple[float, int, Sim3]) -> Array:
    """Frames by moment (s), keyframe and pose in it."""
    table = np.zeros(len(entries), FRAME)
    for i, (t_s, keyframe, T) in enumerate(entries):
        table[i]["t_ns"], table[i]["keyframe"] = round(t_s * 1e9), keyframe
        table[i]["T_kf"] = np.concatenate([T.R.ravel(), T.t, [T.scale]])
    return table


def test_sub_maps_are_named_by_their_first_keyframe() -> None:
    assert survey(rows()).components() == [0, 3]


def test_the_path_has_every_posed_frame_of_the_sub_map_in_the_order_of_time() -> None:
    frames = rows(
        (0.3, 1, STEP), (0.1, 0, Sim3.identity()), (0.2, 0, STEP), (0.4, 3, STEP), (0.5, NONE, STEP)
    )
    path = survey(frames).path(0)
    np.testing.assert_allclose(path.t_s, [0.1, 0.2, 0.3])
    expected = [POSES[0], POSES[0] @ STEP, POSES[1] @ STEP]
    np.testing.assert_allclose(path.p_m, [T.t for T in expected], atol=1e-12)
    np.testing.assert_allclose(path.R_mc, [T.R for T in expected], atol=1e-12)
    np.testing.assert_allclose(survey(frames).path(3).p_m, [(POSES[3] @ STEP).t], atol=1e-12)


def test_two_frames_of_one_moment_are_one_pose() -> None:
    assert len(survey(rows((0.1, 0, STEP), (0.1, 1, STEP), (0.2, 1, STEP))).path(0)) == 2


def test_frames_of_keyframes_that_the_graph_does_not_have_yet_are_left_out() -> None:
    assert len(survey(rows((0.1, 0, STEP), (0.2, 9, STEP))).path(0)) == 1


def test_a_sub_map_without_a_posed_frame_has_an_empty_path() -> None:
    path = survey(rows((0.5, NONE, STEP))).path(0)
    assert len(path) == 0
    assert path.R_mc.shape == (0, 3, 3)


def test_the_ground_is_the_points_of_all_keyframes_of_the_sub_map_in_its_world() -> None:
    rng = np.random.default_rng(0)
    clouds = tuple(rng.normal(size=(5, 3)) for _ in range(2))
    ground = survey(rows(), (clouds[0], np.zeros((0, 3)), clouds[1])).ground(0)
    expected = np.concatenate([POSES[0].apply(clouds[0]), POSES[2].apply(clouds[1])])
    np.testing.assert_allclose(ground, expected)
    assert survey(rows(), clouds).ground(3).shape == (0, 3)


def test_a_large_ground_is_thinned_evenly() -> None:
    many = np.zeros((MOST_POINTS + 1, 3))
    assert MOST_POINTS / 2 < len(survey(rows(), (many,)).ground(0)) <= MOST_POINTS
