"""Dives of a few seconds: the scale has no bias, and stated sigmas are true."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.config import FusionConfig
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import SimulatedDive, simulate
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.device_clocks import LATENCY_S
from aquaflow.telemetry.estimator import estimate
from aquaflow.types import Depth, Velocity
from tests.telemetry.simulated_dives import (
    NOTHING,
    Swum,
    estimated,
    stated_mounting,
    swum,
    telemetry_of,
)

Array = npt.NDArray[np.float64]

KINDS = ("depth", "attitude", "velocity", "angular_rate")
COUNTS = [3, pytest.param(100, marks=pytest.mark.slow)]
LARGEST_SIGMAS = 4.0
EXACT = {
    "wave_height_m": 0.0, "tide_amplitude_m": 0.0, "depth_sigma_m": 0.0, "dvl_sigma_m_s": 0.0,
    "dvl_scale_sigma": 0.0, "attitude_sigma_deg": 0.0, "tilt_wander_sigma_deg": 0.0,
}  # fmt: skip
"""Instruments without errors, but for their rates and the compass."""


def config(seed: int, frames: int, **settings: object) -> SyntheticConfig:
    """A loop over the reef, however short."""
    drawn = {"seed": seed, "frames": frames, "width": 64, "height": 48, "max_range_m": 4.0}
    return SyntheticConfig.model_validate(drawn | settings)


@pytest.mark.parametrize("frames", [40, 80])
def test_without_errors_the_scale_and_gravity_of_a_loop_in_seconds_are_true(frames: int) -> None:
    dive = simulate(config(0, frames, telemetry=EXACT))
    R, p = dive.T_wc[:, :3, :3], dive.T_wc[:, :3, 3]
    path = CameraPath(dive.times_s, R, p)
    found = estimate(
        telemetry_of(dive, *KINDS), path, FusionConfig(), stated_mounting(dive), lambda: NOTHING
    ).frame
    assert abs(found.T_nm.scale - 1.0) < 0.001
    assert np.arccos(found.T_nm.R[2, 2]) < np.radians(1.0)


def late(dive: SimulatedDive, by_s: float) -> SimulatedDive:
    """Depths and velocities stamped so much too late."""
    by_ns = round(1e9 * by_s)
    samples = [
        replace(sample, t_ns=sample.t_ns + by_ns, arrival_ns=sample.arrival_ns + by_ns)
        if isinstance(sample, (Depth, Velocity))
        else sample
        for sample in dive.samples
    ]
    return replace(dive, samples=samples)


def drawn(seed: int) -> Swum:
    """1.5 to 12 s, with a mounting and a latency that err as much as the estimator expects."""
    rng = np.random.default_rng(seed)
    sigma_deg = FusionConfig().mounting_sigma_deg
    error_deg = float(np.linalg.norm(sigma_deg * rng.standard_normal(3)))
    frames = int(rng.integers(16, 121))
    made = swum(config(seed, frames, mounting_error_deg=error_deg), *KINDS)
    shifted = late(made.dive, LATENCY_S * rng.standard_normal())
    return replace(made, telemetry=telemetry_of(shifted, *KINDS))


@pytest.mark.parametrize("count", COUNTS)
def test_sigmas_of_short_dives_are_true(count: int) -> None:
    scale, tilt, heading = [], [], []
    for seed in range(count):
        made = drawn(seed)
        found = estimated(made).frame
        assert found.level
        turn = Rotation.from_matrix(made.T_nm.R @ found.T_nm.R.T).as_rotvec()
        tilt.append(turn[:2] @ np.linalg.solve(found.covariance[3:5, 3:5], turn[:2]) / 2.0)
        heading.append(turn[2] / found.heading_sigma_rad)
        if found.metric:
            scale.append(np.log(found.T_nm.scale / made.T_nm.scale) / found.scale_sigma)
    sizes = np.sqrt([np.mean(np.square(scale)), np.mean(tilt), np.mean(np.square(heading))])
    assert len(scale) > 0.8 * count
    assert (sizes < (1.25 if count > 50 else LARGEST_SIGMAS)).all()
    assert np.abs(scale).max() < LARGEST_SIGMAS
    if count > 50:
        assert (sizes > 0.7).all()
        assert abs(np.mean(scale)) < 0.3
