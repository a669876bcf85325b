"""Offsets between pictures and devices, piece by piece, from the rotations of both."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.device_clocks import DeviceClocks
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.types import AngularRate, Depth
from tests.telemetry.turning import orientations, random_rates, shaken

Array = npt.NDArray[np.float64]


def dive(stamp: Callable[[float], float], seconds: float = 40.0) -> tuple[Telemetry, CameraPath]:
    """A camera at 5 Hz for the middle part of a gyro's log; ``stamp`` of a moment of the gyro."""
    rng = np.random.default_rng(4)
    t = np.arange(-40.0, seconds + 40.0, 0.02)
    rate, telemetry = random_rates(rng, t), Telemetry()
    for at, (x, y, z) in zip(t.tolist(), rate.tolist(), strict=True):
        t_ns = round(1e9 * stamp(at))
        telemetry.add(AngularRate(t_ns, t_ns, "autopilot/RAW_IMU", (x, y, z)))
    for at in t[::5].tolist():
        t_ns = round(1e9 * stamp(at))
        telemetry.add(Depth(t_ns, t_ns, "autopilot/SCALED_PRESSURE2", at))
    seen = (t >= 0.0) & (t <= seconds)
    R = shaken(orientations(t, rate)[seen][::10], np.radians(0.1), rng)
    return telemetry, CameraPath(t[seen][::10], R, np.zeros((len(R), 3)))


def test_clocks_that_agree_leave_telemetry_as_it_is() -> None:
    telemetry, path = dive(lambda t: t)
    clocks = DeviceClocks.of(telemetry, path, np.eye(3))
    assert clocks.known
    assert clocks.correct(telemetry) is telemetry


@pytest.mark.parametrize("offset_s", [-28.0, -9.0, -0.2, 0.2, 9.0, 28.0])
@pytest.mark.parametrize("mounting", [np.eye(3), None])
def test_an_offset_is_found_and_taken_out_of_every_source(
    offset_s: float, mounting: Array | None
) -> None:
    telemetry, path = dive(lambda t: t + offset_s)
    clocks = DeviceClocks.of(telemetry, path, mounting)
    assert clocks.reference.latest_s == pytest.approx(-offset_s, abs=0.02)
    [depth] = clocks.correct(telemetry).of(Depth)
    assert np.abs(depth.values[:, 0] - depth.t_s).max() < 0.05  # depth is the true time here
    assert "corrected" in clocks.reference.in_words()


def test_where_a_clock_steps_the_samples_between_are_left_out() -> None:
    telemetry, path = dive(lambda t: t + (5.0 if t > 18.0 else 0.0))
    [depth] = DeviceClocks.of(telemetry, path, np.eye(3)).correct(telemetry).of(Depth)
    within = (depth.t_s >= 0.0) & (depth.t_s <= 40.0)
    assert within.sum() > 50
    assert np.abs(depth.values[within, 0] - depth.t_s[within]).max() < 0.1


def test_a_gyro_of_another_vehicle_shows_no_clock() -> None:
    telemetry, path = dive(lambda t: t)
    rng = np.random.default_rng(9)
    R = orientations(path.t_s, random_rates(rng, path.t_s))
    clocks = DeviceClocks.of(telemetry, CameraPath(path.t_s, R, path.p_m), np.eye(3))
    assert not clocks.known
    assert clocks.reference.unlike
