"""Motion between two frames from gyro and DVL, against motions that are known."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aquaflow.geometry.similarity import so3_log
from aquaflow.telemetry.dead_reckoning import HELD_S, KEPT_S, RecentMotion
from aquaflow.types import AngularRate, Depth, Velocity


def rates(
    rate: tuple[float, float, float], first_s: float, last_s: float, hz: float = 50.0
) -> RecentMotion:
    recent = RecentMotion()
    for t_s in np.arange(first_s, last_s + 1e-9, 1.0 / hz):
        t_ns = round(t_s * 1e9)
        recent.add(AngularRate(t_ns, t_ns, "gyro", rate))
    return recent


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3), st.floats(0.3, 0.6), st.floats(0.02, 1.0))
def test_a_constant_rate_turns_by_rate_times_time(
    rate: tuple[float, float, float], first_s: float, span_s: float
) -> None:
    R = rates(rate, 0.0, 2.0).turn(first_s, first_s + span_s)
    assert R is not None
    assert np.allclose(so3_log(R), span_s * np.array(rate), atol=1e-9)


def test_a_swinging_body_ends_where_its_rates_lead() -> None:
    recent = RecentMotion()
    truth = [Rotation.from_rotvec([0.3 * np.sin(t), 0.2 * np.cos(2 * t), 0.5 * t]) for t in
             np.arange(0.0, 1.0001, 0.005)]  # fmt: skip
    for k in range(1, len(truth) - 1):
        rate = (truth[k - 1].inv() * truth[k + 1]).as_rotvec() / 0.01
        t_ns = round(0.005e9 * k)
        recent.add(AngularRate(t_ns, t_ns, "gyro", (rate[0], rate[1], rate[2])))
    R = recent.turn(0.2, 0.8)
    assert R is not None
    assert np.linalg.norm(so3_log((truth[40].inv() * truth[160]).as_matrix().T @ R)) < 1e-4


def test_the_newest_rate_holds_for_what_has_not_arrived_and_no_longer() -> None:
    recent = rates((0.0, 0.0, 1.0), 0.0, 1.0)
    late = recent.turn(0.5, 1.0 + 0.9 * HELD_S)
    assert late is not None
    assert np.isclose(so3_log(late)[2], 0.5 + 0.9 * HELD_S)
    assert recent.turn(0.5, 1.0 + 1.1 * HELD_S) is None


def test_a_gap_or_no_gyro_says_nothing() -> None:
    recent = rates((0.1, 0.0, 0.0), 0.0, 1.0)
    for t_s in (1.5, 1.52):
        recent.add(AngularRate(round(t_s * 1e9), 0, "gyro", (0.1, 0.0, 0.0)))
    assert recent.turn(0.9, 1.51) is None
    assert RecentMotion().turn(0.0, 0.1) is None
    assert recent.displacement(0.0, 0.1) is None


def test_displacement_is_the_integral_of_the_velocity() -> None:
    recent = RecentMotion()
    recent.add(Depth(0, 0, "bar30", 3.0))
    for k in range(20):
        t_ns = 200_000_000 * k
        recent.add(Velocity(t_ns, t_ns, "dvl", (0.1 * k, 0.0, -0.2), 0.01))
    moved = recent.displacement(1.0, 2.0)
    assert moved is not None
    assert np.allclose(moved, [0.75, 0.0, -0.2], atol=1e-9)


def test_memory_is_bounded_and_a_clock_set_back_is_passed_over() -> None:
    recent = rates((0.0, 0.0, 0.5), 0.0, 10.0)
    assert len(recent._rates["gyro"]) <= 50 * KEPT_S + 2
    recent.add(AngularRate(1, 1, "gyro", (9.0, 9.0, 9.0)))
    R = recent.turn(9.0, 10.0)
    assert R is not None
    assert np.allclose(so3_log(R), [0.0, 0.0, 0.5])
