"""Offsets between pictures and devices, piece by piece, from the rotations of both."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.device_clocks import DeviceClocks
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import WorldFrame
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


@pytest.mark.parametrize("drift", [-0.06, 0.06])
@pytest.mark.parametrize("mounting", [np.eye(3), None])
def test_nothing_is_used_that_a_clock_of_another_rate_has_stamped(
    drift: float, mounting: Array | None
) -> None:
    telemetry, path = dive(lambda t: (1.0 + drift) * t, seconds=6.0)
    clocks = DeviceClocks.of(telemetry, path, mounting)
    assert not clocks.known
    [(key, report)] = clocks.left_out(telemetry).items()
    assert key == ("autopilot/SCALED_PRESSURE2", "depth")
    assert f"% {'faster' if drift > 0.0 else 'slower'} than that of the pictures" in report.reason
    assert report.reason in clocks.with_clocks(WorldFrame.unknown()).scale_source


@pytest.mark.parametrize(("drift", "most"), [(0.0, 0.01), (0.03, 0.05), (-0.03, 0.05)])
def test_a_drift_that_is_not_corrected_is_part_of_the_sigma(drift: float, most: float) -> None:
    telemetry, path = dive(lambda t: (1.0 + drift) * t, seconds=6.0)
    clock = DeviceClocks.of(telemetry, path, np.eye(3)).reference
    assert clock.known
    assert 0.8 * abs(drift) < clock.sigma[1] < most


@pytest.mark.parametrize(("offset_s", "least_s"), [(0.0, 0.0), (0.08, 0.08), (0.3, 0.0)])
def test_an_offset_that_is_not_corrected_is_part_of_the_sigma(
    offset_s: float, least_s: float
) -> None:
    telemetry, path = dive(lambda t: t + offset_s)
    sigma_s = DeviceClocks.of(telemetry, path, np.eye(3)).reference.sigma[0]
    assert least_s < sigma_s < least_s + 0.03
