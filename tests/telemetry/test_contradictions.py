"""A source that is wrong as a whole is left out, and named with what gave it away."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.telemetry.estimator import Estimate
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.telemetry.world_frame import SourceReport
from aquaflow.types import KIND_OF, Altitude, Attitude, Depth, TelemetrySample, Velocity
from tests.telemetry.simulated_dives import Swum, estimated, swum

Change = Callable[[TelemetrySample], TelemetrySample]
WITHOUT_ALTITUDE = ("depth", "attitude", "velocity")
ALL = (*WITHOUT_ALTITUDE, "altitude")


@pytest.fixture(scope="module")
def dive() -> Swum:
    return swum(SyntheticConfig(seed=1, frames=160, fps=4.0, scene="flat_sand"), *ALL)


@pytest.fixture(scope="module")
def floor(dive: Swum) -> np.ndarray:
    """[N, 3] a plane at the altimeter's ranges, in the map."""
    measured = [each.altitude_m for each in dive.dive.samples if isinstance(each, Altitude)]
    places = dive.dive.T_wc[:, :3, 3]
    steps = np.linspace(-1.5, 1.5, 9)
    grid = np.array([[x, y, 0.0] for x in steps for y in steps])
    points = (places[::3, None] + grid).reshape(-1, 3)
    points[:, 2] = places[:, 2].mean() + np.median(measured)
    return np.asarray(dive.T_nm.inverse().apply(points))


def in_wrong_units(sample: TelemetrySample) -> TelemetrySample:
    if not isinstance(sample, Velocity):
        return sample
    x, y, z = (1.5 * each for each in sample.velocity_m_s)
    return replace(sample, velocity_m_s=(x, y, z))


def in_feet(sample: TelemetrySample) -> TelemetrySample:
    if not isinstance(sample, Depth):
        return sample
    return replace(sample, depth_m=sample.depth_m / 0.3048)


def of_another_vehicle(sample: TelemetrySample) -> TelemetrySample:
    if not isinstance(sample, Attitude):
        return sample
    t = 1e-9 * sample.t_ns
    angles = (0.5 * t, 0.4 * np.sin(0.9 * t), 0.5 * np.sin(1.3 * t))
    w, x, y, z = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True).tolist()
    return replace(sample, wxyz=(w, x, y, z))


def to_the_side(sample: TelemetrySample) -> TelemetrySample:
    if not isinstance(sample, Altitude):
        return sample
    return replace(sample, altitude_m=4.0 + 2.5 * float(np.sin(0.3e-9 * sample.t_ns)))


def what_comes_of(
    dive: Swum, floor: np.ndarray, change: Change, kinds: tuple[str, ...] = ALL
) -> Estimate:
    telemetry = Telemetry()
    for sample in dive.dive.samples:
        if KIND_OF[type(sample)] in kinds:
            telemetry.add(change(sample))
    return estimated(replace(dive, telemetry=telemetry), floor)


def left_out(estimate: Estimate) -> dict[str, SourceReport]:
    return {each.kind: each for each in estimate.frame.sources if not each.used}


@pytest.mark.parametrize(
    ("change", "kind", "times", "kinds"),
    [
        (in_wrong_units, "velocity", 1.5, WITHOUT_ALTITUDE),
        (in_feet, "depth", 3.28, ALL),
        pytest.param(in_wrong_units, "velocity", 1.5, ALL, marks=pytest.mark.slow),
        pytest.param(in_feet, "depth", 3.28, WITHOUT_ALTITUDE, marks=pytest.mark.slow),
    ],
)
def test_a_source_in_wrong_units_is_left_out(
    dive: Swum, floor: np.ndarray, change: Change, kind: str, times: float, kinds: tuple[str, ...]
) -> None:
    estimate = what_comes_of(dive, floor, change, kinds)
    ((wrong, report),) = left_out(estimate).items()
    assert wrong == kind
    assert report.rejected > 20
    said = report.reason.split()
    assert said[:3] == ["its", "lengths", "are"]
    assert float(said[3]) == pytest.approx(times, rel=0.03)
    assert abs(np.log(estimate.frame.T_nm.scale / dive.T_nm.scale)) < 0.02


def test_an_attitude_of_another_vehicle_is_left_out(dive: Swum, floor: np.ndarray) -> None:
    estimate = what_comes_of(dive, floor, of_another_vehicle)
    assert set(left_out(estimate)) == {"attitude"}
    assert "the log's rotations" in left_out(estimate)["attitude"].reason
    assert estimate.frame.metric
    assert estimate.frame.north == "initial heading"


def test_an_altimeter_that_looks_to_the_side_is_left_out(dive: Swum, floor: np.ndarray) -> None:
    estimate = what_comes_of(dive, floor, to_the_side)
    assert set(left_out(estimate)) == {"altitude"}
    assert abs(np.log(estimate.frame.T_nm.scale / dive.T_nm.scale)) < 0.02


def test_sources_that_agree_are_all_used(dive: Swum, floor: np.ndarray) -> None:
    estimate = what_comes_of(dive, floor, lambda sample: sample)
    assert left_out(estimate) == {}
