"""A simulated dive: its instruments, mountings and motion agree with each other."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import SimulatedDive, simulate, write_dive
from aquaflow.lab.synthetic.motion import TrueBodyMotion
from aquaflow.lab.synthetic.telemetry import read_telemetry
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise
from aquaflow.lab.synthetic.truth import read_truth
from aquaflow.recordings.synthetic import SyntheticDive
from aquaflow.types import Altitude, AngularRate, Attitude, Depth, Velocity
from tests.lab.synthetic.without_errors import WITHOUT_ERRORS

Array = npt.NDArray[np.float64]
Kind = TypeVar("Kind")
RATES = [name for name in TelemetryNoise.model_fields if name.endswith("_hz")]


def dive(telemetry: dict[str, float] | None = None, **settings: object) -> SimulatedDive:
    """A dive with perfect instruments, but for ``telemetry``."""
    noise = {**WITHOUT_ERRORS, **(telemetry or {})}
    return simulate(SyntheticConfig.model_validate({"telemetry": noise, **settings}))


def motion(**settings: object) -> TrueBodyMotion:
    """Of a dive whose instruments are all silent: their samples are most of the work."""
    return dive(dict.fromkeys(RATES, 0.0), **settings).motion


def heard(simulated: SimulatedDive, kind: type[Kind]) -> tuple[Array, list[Kind]]:
    """Times [N] s and samples of one kind."""
    stamps = [s.t_ns for s in simulated.samples if isinstance(s, kind)]
    return np.array(stamps) * 1e-9, [s for s in simulated.samples if isinstance(s, kind)]


@pytest.fixture(scope="module")
def perfect() -> SimulatedDive:
    return dive(frames=300, altitude_m=2.0, altitude_swing_m=0.6)


def test_camera_and_body_are_one_rigid_body(perfect: SimulatedDive) -> None:
    T_wb = perfect.T_wc @ np.linalg.inv(perfect.T_bc)
    t = perfect.times_s
    np.testing.assert_allclose(T_wb[:, :3, 3], perfect.motion.origin_w(t), atol=1e-9)
    np.testing.assert_allclose(T_wb[:, :3, :3], perfect.motion.R_wb(t), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(perfect.T_bc[:3, 3]), np.hypot(0.2, 0.05))


def test_velocity_is_that_of_the_bodys_origin_not_of_the_camera(perfect: SimulatedDive) -> None:
    t, samples = heard(perfect, Velocity)
    t = t[1:-1]
    half = 1e-3
    moved = perfect.motion.origin_w(t + half) - perfect.motion.origin_w(t - half)
    in_body = np.einsum("nji,nj->ni", perfect.motion.R_wb(t), moved / (2 * half))
    np.testing.assert_allclose([s.velocity_m_s for s in samples[1:-1]], in_body, atol=1e-5)


def test_rates_turn_one_attitude_into_the_next(perfect: SimulatedDive) -> None:
    t, samples = heard(perfect, AngularRate)
    rates = np.array([s.rate_rad_s for s in samples])
    R = Rotation.from_matrix(perfect.motion.R_wb(t))
    turned = (R[:-1].inv() * R[1:]).as_rotvec() / np.diff(t)[:, None]
    np.testing.assert_allclose(turned, 0.5 * (rates[1:] + rates[:-1]), atol=2e-4)
    t, attitudes = heard(perfect, Attitude)
    measured = Rotation.from_quat(np.roll([s.wxyz for s in attitudes], -1, axis=1))
    error = measured.inv() * Rotation.from_matrix(perfect.motion.R_wb(t))
    assert error.magnitude().max() < 1e-7


def test_specific_force_is_gravity_and_the_change_of_velocity(perfect: SimulatedDive) -> None:
    t = np.linspace(0.0, 29.0, 5801)
    force_w = np.einsum("nij,nj->ni", perfect.motion.R_wb(t), perfect.motion.force_b(t))
    force_w[:, 2] += 9.80665
    gained = 0.5 * (force_w[1:] + force_w[:-1]).sum(axis=0) * (t[1] - t[0])
    change = perfect.motion.velocity_w(t[-1:]) - perfect.motion.velocity_w(t[:1])
    np.testing.assert_allclose(gained, change[0], atol=2e-3)


def test_depth_spans_a_metre_at_the_speed_of_an_rov(perfect: SimulatedDive) -> None:
    depths = [s.depth_m for s in heard(perfect, Depth)[1]]
    assert np.ptp(depths) > 1.0
    speed = [np.linalg.norm(s.velocity_m_s) for s in heard(perfect, Velocity)[1]]
    assert 0.4 < np.median(speed) < 0.9


def test_altitude_is_the_distance_to_the_ground_below() -> None:
    over_sand = dive(frames=100, scene="flat_sand")
    t, samples = heard(over_sand, Altitude)
    above = over_sand.config.floor_depth_m - over_sand.motion.origin_w(t)[:, 2]
    measured = np.array([s.altitude_m for s in samples])
    # Dunes of 5 cm, and what lies on them is up to 0.22 m high below the vehicle.
    assert np.abs(np.median(measured - above)) < 0.1
    assert np.all(np.abs(measured - above) < 0.35)


def test_altimeter_beside_a_wall_hears_the_wall_or_nothing() -> None:
    wide = dive(frames=100, scene="wall")
    t, samples = heard(wide, Altitude)
    north = wide.motion.origin_w(t)[:, 0]
    # At 12.5 degrees off the wall's plane, its nearest echo is at the stand-off over the sine.
    expected = -north / np.sin(np.radians(12.5))
    measured = np.array([s.altitude_m for s in samples])
    assert 0.4 < np.median(measured / expected) < 1.2
    narrow = dive({"altitude_longest_m": 3.0}, frames=100, scene="wall")
    assert heard(narrow, Altitude)[1] == []


def test_samples_come_in_order_of_arrival_and_never_before_they_were_measured() -> None:
    samples = simulate(SyntheticConfig(frames=50)).samples
    assert all(s.arrival_ns >= s.t_ns for s in samples)
    assert [s.arrival_ns for s in samples] == sorted(s.arrival_ns for s in samples)
    late = np.array([s.arrival_ns - s.t_ns for s in samples]) * 1e-9
    assert 0.02 < late.mean() < 0.06


def test_a_log_that_starts_late_lacks_its_beginning_and_nothing_else() -> None:
    whole, late = dive(frames=50), dive({"starts_late_s": 2.0}, frames=50)
    assert late.samples == [s for s in whole.samples if s.t_ns >= 2_000_000_000]
    assert len(late.samples) < len(whole.samples)


def test_instruments_that_are_not_aboard_are_silent() -> None:
    bare = dive({"dvl_hz": 0.0, "altitude_hz": 0.0, "utc_hz": 0.0}, frames=30)
    kinds = {type(sample).__name__ for sample in bare.samples}
    assert kinds == {"Depth", "Attitude", "AngularRate", "Acceleration"}
    equipped = dive({"position_hz": 1.0}, frames=30)
    kinds |= {"Velocity", "Altitude", "Position", "UtcTime"}
    assert {type(sample).__name__ for sample in equipped.samples} == kinds


def test_a_vehicle_that_turns_points_along_its_way() -> None:
    t = 0.1 * np.arange(600)
    held, turning = motion(frames=600), motion(frames=600, turns=True)
    for of_dive, least, most in ((held, -0.5, 0.5), (turning, 0.75, 1.0)):
        velocity = of_dive.velocity_b(t)
        ahead = np.median(velocity[:, 0] / np.linalg.norm(velocity, axis=1))
        assert least < ahead <= most
    rate = np.degrees(turning.rate_b(t))[:, 2]
    assert 20.0 < np.abs(rate).max() < 40.0
    heading = np.unwrap(Rotation.from_matrix(turning.R_wb(t)).as_euler("ZYX")[:, 0])
    assert np.ptp(heading) > np.pi


def test_a_vehicle_at_a_wall_cannot_be_asked_to_turn() -> None:
    with pytest.raises(ValidationError, match="turns must be false"):
        SyntheticConfig.model_validate({"scene": "wall", "turns": True})


SCENES = ("reef", "flat_sand", "pipe", "wall", "survey")
MINUTES = [
    *[(scene, 60) for scene in SCENES],
    ("reef", 120),
    *[pytest.param(scene, 120, marks=pytest.mark.slow) for scene in SCENES[1:]],
]


@pytest.mark.parametrize(("scene", "seconds"), MINUTES)
def test_dives_of_a_minute_or_two_span_a_metre_of_depth(scene: str, seconds: int) -> None:
    frames = 4 * seconds
    way = motion(scene=scene, frames=frames, fps=4.0, altitude_m=2.0, altitude_swing_m=0.7)
    t = np.linspace(0.0, seconds - 1.0, 200)
    assert np.ptp(way.origin_w(t)[:, 2]) > 1.0
    assert np.abs(way.velocity_w(t)[:, 2]).max() < 1.0


@pytest.mark.parametrize("scene", ["reef", "wall"])
def test_mounting_errors_have_the_stated_size_and_turn_camera_and_dvl(scene: str) -> None:
    wrong = dive(frames=30, mounting_error_deg=3.0, scene=scene)
    R = wrong.T_bc_stated[:3, :3].T @ wrong.T_bc[:3, :3]
    assert np.degrees(Rotation.from_matrix(R).magnitude()) == pytest.approx(3.0)
    assert np.degrees(Rotation.from_matrix(wrong.R_bd).magnitude()) == pytest.approx(3.0)
    t, samples = heard(wrong, Velocity)
    measured = np.array([s.velocity_m_s for s in samples])
    np.testing.assert_allclose(measured @ wrong.R_bd.T, wrong.motion.velocity_b(t), atol=1e-8)
    right = dive(frames=30, scene=scene)
    np.testing.assert_allclose(right.T_bc, wrong.T_bc_stated)
    np.testing.assert_allclose(
        wrong.T_wc[:, :3, :3], wrong.motion.R_wb(wrong.times_s) @ wrong.T_bc[:3, :3], atol=1e-12
    )


@pytest.mark.parametrize("scene", ["reef", "wall", "survey"])
def test_the_stated_mounting_is_that_of_a_vehicles_configuration(scene: str) -> None:
    simulated = dive(frames=12, scene=scene, mounting_error_deg=3.0)
    stated = simulated.mounting
    angles = (stated.yaw_deg, stated.pitch_deg, stated.roll_deg)
    # Columns: a forward camera's right, down and forward in the body.
    forward = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    R_bc = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix() @ forward
    np.testing.assert_allclose(R_bc, simulated.T_bc_stated[:3, :3], atol=1e-12)
    np.testing.assert_allclose(stated.position_m, simulated.T_bc_stated[:3, 3])


def test_noise_of_one_instrument_changes_no_other_and_no_motion() -> None:
    config = SyntheticConfig(frames=40)
    noisy = config.model_copy(
        update={"telemetry": config.telemetry.model_copy(update={"depth_sigma_m": 1.0})}
    )
    one, other = simulate(config), simulate(noisy)
    np.testing.assert_array_equal(one.T_wc, other.T_wc)
    assert [s for s in one.samples if not isinstance(s, Depth)] == [
        s for s in other.samples if not isinstance(s, Depth)
    ]
    assert heard(one, Depth)[1] != heard(other, Depth)[1]


def test_the_same_seed_gives_the_same_dive_and_another_seed_another() -> None:
    one, again, other = (simulate(SyntheticConfig(frames=20, seed=s)) for s in (4, 4, 5))
    assert one.samples == again.samples
    np.testing.assert_array_equal(one.T_wc, again.T_wc)
    assert one.samples != other.samples


def test_a_written_dive_states_its_mounting_and_keeps_the_truth(tmp_path: Path) -> None:
    config = SyntheticConfig(
        frames=2, width=64, height=48, supersampling=1, mounting_error_deg=3.0, fps=1.0
    )
    write_dive(tmp_path, config)
    truth, simulated = read_truth(tmp_path), simulate(config)
    assert truth.config == config
    np.testing.assert_allclose(truth.T_bc, simulated.T_bc, atol=1e-12)
    np.testing.assert_allclose(truth.T_bc_stated, simulated.T_bc_stated, atol=1e-12)
    np.testing.assert_allclose(truth.R_bc, truth.T_bc[:3, :3])
    np.testing.assert_allclose(truth.errors["R_body_dvl"], simulated.R_bd, atol=1e-12)
    assert truth.errors["dvl_scale"] == simulated.constants.dvl_scale
    assert SyntheticDive.open(tmp_path).stated_mounting() == simulated.mounting
    first = next(s for s in read_telemetry(tmp_path / "telemetry.csv") if isinstance(s, Depth))
    T_wb = truth.T_wc @ np.linalg.inv(truth.T_bc)
    offset = truth.errors["depth_offset_m"]
    assert first.depth_m == pytest.approx(T_wb[0, 2, 3] + offset, abs=0.1)


def test_dives_of_version_1_are_still_read(tmp_path: Path) -> None:
    write_dive(tmp_path, SyntheticConfig(frames=2, width=64, height=48, supersampling=1))
    stated = tmp_path / "synth.yaml"
    text = stated.read_text()
    before, after = text.index("truth:"), text.index("vignette: image")
    stated.write_text(text[:before] + text[after:])
    truth = read_truth(tmp_path)
    np.testing.assert_array_equal(truth.T_bc, truth.T_bc_stated)
    assert truth.errors == {}
