"""Scale and gravity of many simulated dives, and whether the stated sigmas are true."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.telemetry.estimator import Estimate
from tests.telemetry.simulated_dives import Swum, estimated, ground_of, swum, telemetry_of

Array = npt.NDArray[np.float64]

KINDS = ("depth", "attitude", "velocity", "altitude")
COUNTS = [2, pytest.param(100, marks=pytest.mark.slow)]
LARGEST_SIGMAS = 4.0


@dataclass(frozen=True)
class Errors:
    """Of many dives."""

    scale: Array
    """Relative."""
    scale_sigmas: Array
    tilt_deg: Array
    tilt_square: Array
    """Normalised error squared, of two degrees of freedom."""

    def percent(self, share: float) -> float:
        """Quantile of the scale's error, %."""
        return float(100.0 * np.quantile(np.abs(self.scale), share))

    def assert_sigmas_are_true(self) -> None:
        """Mean normalised error squared of the scale within 95 % of chi-square."""
        low, high = chi2.ppf((0.025, 0.975), len(self.scale)) / len(self.scale)
        assert low <= float((self.scale_sigmas**2).mean()) <= high
        assert float(np.abs(self.scale_sigmas).max()) <= LARGEST_SIGMAS


def config(seed: int) -> SyntheticConfig:
    """A minute of a small ROV: the depth changes by a metre at least."""
    rng = np.random.default_rng(seed)
    return SyntheticConfig.model_validate(
        {
            "seed": seed, "frames": 600, "fps": 10, "width": 64, "height": 48,
            "altitude_swing_m": float(rng.uniform(0.5, 1.0)),
            "altitude_m": 2.0 + float(rng.uniform(0.0, 1.0)),
            "speed_m_s": float(rng.uniform(0.3, 0.7)),
            "mounting_error_deg": float(rng.uniform(0.0, 4.0)),
            "scene": str(rng.choice(["reef", "flat_sand", "pipe"])),
        }
    )  # fmt: skip


@functools.cache
def dive(seed: int) -> Swum:
    """With all instruments."""
    made = swum(config(seed), *KINDS)
    assert np.ptp(made.dive.T_wc[:, 2, 3]) >= 1.0
    return made


@functools.cache
def estimate_of(seed: int, *kinds: str) -> Estimate:
    """From some of the instruments."""
    whole = dive(seed)
    part = Swum(whole.dive, whole.path, whole.T_nm, telemetry_of(whole.dive, *kinds))
    points = ground_of(part, seed) if "altitude" in kinds else np.zeros((0, 3))
    return estimated(part, points)


def errors(count: int, *kinds: str) -> Errors:
    rows = []
    for seed in range(count):
        frame, T_nm = estimate_of(seed, *kinds).frame, dive(seed).T_nm
        assert frame.metric, frame.scale_source
        assert frame.level
        scale = float(np.log(frame.T_nm.scale / T_nm.scale))
        tilt = Rotation.from_matrix(T_nm.R @ frame.T_nm.R.T).as_rotvec()[:2]
        square = tilt @ np.linalg.solve(frame.covariance[3:5, 3:5], tilt)
        rows.append((scale, scale / frame.scale_sigma, np.degrees(np.linalg.norm(tilt)), square))
    return Errors(*np.array(rows).T)


@pytest.mark.parametrize("count", COUNTS)
def test_depth_and_attitude_give_the_scale_to_half_a_percent(count: int) -> None:
    found = errors(count, "depth", "attitude")
    assert found.percent(0.5) <= 0.5
    assert found.percent(0.95) <= 1.5
    assert np.quantile(found.tilt_deg, 0.95) <= 0.3
    found.assert_sigmas_are_true()


@pytest.mark.parametrize("count", COUNTS)
def test_a_dvl_gives_the_scale_to_three_per_mille(count: int) -> None:
    found = errors(count, "depth", "attitude", "velocity")
    assert found.percent(0.95 if count == 100 else 0.5) <= 0.3
    assert np.quantile(found.tilt_deg, 0.95) <= 0.3
    found.assert_sigmas_are_true()


@pytest.mark.parametrize("count", COUNTS)
def test_an_altimeter_gives_the_scale_to_a_percent(count: int) -> None:
    found = errors(count, "attitude", "altitude")
    assert found.percent(0.95) <= 1.0
    found.assert_sigmas_are_true()
