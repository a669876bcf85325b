"""What telemetry wants changed of single keyframes, given the estimator's frame."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.telemetry.estimator import Estimate
from aquaflow.tracking.metric.measured import NEAR_S, Corrections, WorldEdge, world_edges
from tests.telemetry.simulated_dives import Swum, estimated, part_of, swum

Array = npt.NDArray[np.float64]

EVERY = 20
"""Frames from keyframe to keyframe."""


@functools.cache
def dive() -> Swum:
    config = SyntheticConfig.model_validate(
        {
            "seed": 8, "frames": 400, "fps": 10, "width": 64, "height": 48,
            "altitude_m": 2.5, "altitude_swing_m": 0.8,
        }
    )  # fmt: skip
    return swum(config, "depth", "attitude", "velocity")


@functools.cache
def estimate_of(*kinds: str) -> Estimate:
    return estimated(part_of(dive(), *kinds))


def keyframes() -> tuple[Array, Array, Sim3Batch]:
    path = dive().path
    R, t = path.R_mc[::EVERY], path.p_m[::EVERY]
    return np.arange(len(t)), path.t_s[::EVERY], Sim3Batch(R, t, np.ones(len(t)))


def edges(found: Estimate) -> list[WorldEdge]:
    return world_edges(found, *keyframes())


def ranks(found: list[WorldEdge]) -> list[int]:
    return [edge.count for edge in found]


def test_samples_near_a_moment_are_averaged_by_their_sigmas() -> None:
    corrections = Corrections(
        np.array([0.0, 1.0, 1.2, 9.0]), np.array([[5.0], [1.0], [2.0], [7.0]]),
        np.array([1.0, 0.1, 0.2, 1.0]), slow=0.3,
    )  # fmt: skip
    found = corrections.at(1.1)
    assert found is not None
    mean, sigma = found
    assert mean[0] == pytest.approx((1.0 / 0.01 + 2.0 / 0.04) / (1.0 / 0.01 + 1.0 / 0.04))
    assert sigma == pytest.approx(np.hypot((100.0 + 25.0) ** -0.5, 0.3))
    assert corrections.at(1.2 + NEAR_S + 0.5) is None
    assert corrections.at(20.0) is None


def test_every_instrument_measures_its_directions_of_every_keyframe() -> None:
    numbers, _, _ = keyframes()
    whole = edges(estimate_of("depth", "attitude", "velocity"))
    assert [edge.keyframe for edge in whole] == numbers.tolist()
    # Depth, down and north, and the scale wherever the DVL had the bottom.
    assert set(ranks(whole[1:])) <= {4, 5}
    assert ranks(whole[1:]).count(5) > len(whole) / 2
    assert set(ranks(edges(estimate_of("depth", "attitude"))[1:])) == {4}


def test_what_nothing_measures_is_held_at_the_first_keyframe() -> None:
    first = edges(estimate_of("depth", "attitude"))[0]
    assert first.count == 6  # its own four, and its place
    level = edges(estimate_of("attitude"))
    assert level[0].count == 6  # tilt, north, place and depth
    assert set(ranks(level[1:])) == {3}  # no metres: no depth and no scale


def test_a_sub_map_without_gravity_has_no_edges() -> None:
    found = estimate_of("velocity")
    assert not found.frame.level
    assert edges(found) == []


def test_path_and_telemetry_that_agree_have_little_strain() -> None:
    found = edges(estimate_of("depth", "attitude", "velocity"))
    assert sum(e.chi2 for e in found) / sum(e.count for e in found) < 1.5


def test_a_keyframe_that_sank_is_wanted_back_at_its_measured_depth() -> None:
    found = estimate_of("depth", "attitude")
    numbers, t_s, T_mk = keyframes()
    plain = world_edges(found, numbers, t_s, T_mk)
    assert found.problem is not None
    for k in (3, 11):
        depth = found.frame.T_nm.apply(T_mk.t[k : k + 1])[0, 2]
        assert plain[k].T_nk.t[2] == pytest.approx(depth, abs=0.1)  # waves, and the path's bend
        assert plain[k].T_nk.t[:2] == pytest.approx(found.frame.T_nm.apply(T_mk.t[k])[:2])


def test_a_scale_that_is_wrong_everywhere_is_wanted_back() -> None:
    found = estimate_of("depth", "attitude", "velocity")
    assert found.solution is not None
    state = found.solution.state
    grown = replace(state, log_scale=state.log_scale + 0.05)
    T_nm = Sim3(found.frame.T_nm.R, found.frame.T_nm.t, grown.scale)
    wrong = replace(
        found, frame=replace(found.frame, T_nm=T_nm), solution=replace(found.solution, state=grown)
    )
    wanted = [np.log(edge.T_nk.scale / grown.scale) for edge in edges(wrong)[1:] if edge.count == 5]
    assert np.median(wanted) == pytest.approx(-0.05, abs=0.01)


def test_a_tilt_that_is_wrong_is_wanted_back() -> None:
    found = estimate_of("depth", "attitude", "velocity")
    assert found.solution is not None
    turn = Rotation.from_rotvec([0.03, -0.02, 0.0]).as_matrix()
    state = found.solution.state
    tilted = replace(state, R_nm=turn @ state.R_nm)
    T_nm = replace(found.frame.T_nm, R=tilted.R_nm)
    wrong = replace(
        found, frame=replace(found.frame, T_nm=T_nm), solution=replace(found.solution, state=tilted)
    )
    numbers, t_s, T_mk = keyframes()
    turns = [
        Rotation.from_matrix(edge.T_nk.R @ (T_nm @ T_mk.element(i)).R.T).as_rotvec()
        for i, edge in enumerate(world_edges(wrong, numbers, t_s, T_mk))
    ]
    np.testing.assert_allclose(np.median(turns, axis=0)[:2], [-0.03, 0.02], atol=0.006)
