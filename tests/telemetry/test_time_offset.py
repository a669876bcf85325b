"""A video and a log that were never synchronised: the offset found, its sigma, and refusals."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from aquaflow.base.errors import InputError
from aquaflow.recordings.csv_telemetry import CsvTelemetry
from aquaflow.telemetry.time_offset import (
    NotSynchronisedError,
    TimeOffset,
    estimate_time_offset,
    offset_of_log,
    synchronise_samples,
)
from aquaflow.telemetry.turns import Turns
from aquaflow.types import AngularRate, Attitude, Depth, UtcTime
from tests.telemetry.turning import Case, dive, orientations, random_rates, random_rotation, seen

DIVES = 20
FRAME_S = 1.0 / 29.97


@cache
def found(seed: int, attitudes: bool = False) -> tuple[Case, TimeOffset]:
    case = dive(seed, attitudes=attitudes)
    return case, estimate_time_offset(case.camera, case.body)


def angle_rad(R: np.ndarray) -> float:
    return float(np.linalg.norm(Rotation.from_matrix(R).as_rotvec()))


@pytest.mark.parametrize("attitudes", [False, True], ids=["gyro", "attitudes"])
def test_the_offset_of_twenty_dives_is_found_within_20_ms(attitudes: bool) -> None:
    errors = [case.error_s(offset) for case, offset in (found(k, attitudes) for k in range(DIVES))]
    assert max(np.abs(errors)) <= 0.02


@pytest.mark.parametrize("attitudes", [False, True], ids=["gyro", "attitudes"])
def test_the_stated_sigma_of_the_offset_is_true(attitudes: bool) -> None:
    cases = [found(k, attitudes) for k in range(DIVES)]
    normalised = np.array([case.error_s(offset) / offset.sigma_s for case, offset in cases])
    assert np.abs(normalised).max() < 4.0
    assert (normalised**2).sum() < chi2.ppf(0.975, DIVES)
    # White noise on every attitude makes the sigma cautious: at most twice too large.
    floor = 0.25 if attitudes else 1.0
    assert (normalised**2).sum() > floor * chi2.ppf(0.025, DIVES)


def test_the_mounting_is_a_by_product_within_its_sigma() -> None:
    for seed in range(DIVES):
        case, offset = found(seed)
        assert offset.R_cb is not None
        error = angle_rad(offset.R_cb @ case.R_cb.T)
        assert error < 4.0 * offset.rotation_sigma_rad
        assert error < np.radians(3.0)


def test_a_clock_that_runs_fast_is_known_only_from_a_long_overlap() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 1200.0, 0.1)
    rate, R_cb = random_rates(rng, t), random_rotation(rng)
    camera = seen(rng, t, rate, R_cb, every=1)
    drift = 6e-5
    body = Turns.of_rates((t - 7.0) / (1.0 + drift), rate)
    long = estimate_time_offset(camera, body)
    assert long.drift == pytest.approx(drift, abs=4.0 * long.drift_sigma)
    assert long.drift_sigma < 1e-5
    minute = Turns(camera.start_s[:600], camera.end_s[:600], camera.angle_rad[:600])
    short = estimate_time_offset(minute, body)
    assert short.drift == 0.0
    assert short.sigma_at_s(1200.0) > 0.05


@settings(max_examples=15)
@given(
    seed=st.integers(0, 10_000),
    offset_s=st.floats(-1e4, 1e4),
    every=st.integers(1, 8),
    scale=st.floats(0.85, 1.15),
)
def test_any_offset_mounting_and_focal_length_is_found(
    seed: int, offset_s: float, every: int, scale: float
) -> None:
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 90.0, 0.02)
    rate, R_cb = random_rates(rng, t), random_rotation(rng)
    part = slice(1000, 3000)
    camera = seen(rng, t[part], scale * rate[part], R_cb, every=every)
    offset = estimate_time_offset(camera, Turns.of_rates(t - offset_s, rate))
    assert offset.offset_s == pytest.approx(offset_s, abs=max(4.0 * offset.sigma_s, 0.002))
    assert offset.sigma_s < 0.02
    assert offset.scale == pytest.approx(scale, abs=0.03)
    assert offset.correlation > 0.9
    assert offset.R_cb is not None
    assert angle_rad(offset.R_cb @ R_cb.T) < np.radians(3.0)


def test_a_mounting_known_to_some_degrees_excludes_offsets_that_need_another() -> None:
    """A sway that comes back after 20 s, reversed about two of the axes."""
    rng = np.random.default_rng(1)
    t, R_cb = np.arange(0.0, 40.0, 0.02), random_rotation(rng)
    half = random_rates(rng, t[:1000])
    rate = np.concatenate([half, half * [1.0, -1.0, -1.0]])
    camera, body = seen(rng, t[:1000], half, R_cb), Turns.of_rates(t - 3.0, rate)
    with pytest.raises(NotSynchronisedError, match="equally well"):
        estimate_time_offset(camera, body)
    wrong_by_3_degrees = Rotation.from_rotvec([0.0, np.radians(3.0), 0.0]).as_matrix()
    offset = estimate_time_offset(camera, body, wrong_by_3_degrees @ R_cb)
    assert offset.offset_s == pytest.approx(3.0, abs=4.0 * offset.sigma_s)
    assert offset.R_cb is not None
    assert angle_rad(offset.R_cb @ R_cb.T) < np.radians(1.0)


def test_pictures_at_one_a_second_are_compared_over_their_whole_intervals() -> None:
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 400.0, 0.02)
    rate, R_cb = random_rates(rng, t), random_rotation(rng)
    offset = estimate_time_offset(seen(rng, t, rate, R_cb, every=50), Turns.of_rates(t - 3.0, rate))
    assert offset.offset_s == pytest.approx(3.0, abs=4.0 * offset.sigma_s)
    assert offset.sigma_s < 0.02


def test_a_gap_in_the_log_costs_what_lies_in_it() -> None:
    case, whole = found(0)
    gap = (case.body.start_s < whole.middle_s) | (case.body.start_s > whole.middle_s + 8.0)
    body = Turns(case.body.start_s[gap], case.body.end_s[gap], case.body.angle_rad[gap])
    offset = estimate_time_offset(case.camera, body)
    assert abs(case.error_s(offset)) < 4.0 * offset.sigma_s


def test_tracking_that_jumps_now_and_then_moves_the_offset_little() -> None:
    case, _ = found(3)
    angle = case.camera.angle_rad.copy()
    angle[::97] += np.radians(4.0)
    camera = Turns(case.camera.start_s, case.camera.end_s, angle)
    assert abs(case.error_s(estimate_time_offset(camera, case.body))) < 0.02


def test_whole_degrees_once_a_second_are_enough_in_a_longer_dive() -> None:
    """What the subtitles of a ground station hold."""
    rng = np.random.default_rng(6)
    t = np.arange(0.0, 180.0, 0.05)
    rate, R_cb = random_rates(rng, t), random_rotation(rng)
    rate[:, 2] += gaussian_filter1d(12.0 * random_rates(rng, t)[:, 2], 60)
    R = orientations(t, rate)
    degrees = Rotation.from_matrix(R[::20]).as_euler("ZYX", degrees=True).round()
    attitudes = Rotation.from_euler("ZYX", degrees, degrees=True).as_matrix()
    camera = seen(rng, t, rate, R_cb, every=2)
    offset = estimate_time_offset(camera, Turns.of_orientations(t[::20] - 11.3, attitudes))
    assert offset.offset_s == pytest.approx(11.3, abs=4.0 * offset.sigma_s)
    assert offset.sigma_s < 0.02


# --- refusals -------------------------------------------------------------------------------------


def steady(seconds: float, rate_rad_s: float = 0.0) -> Turns:
    """Turns of 0.1 s at a constant rate."""
    t = np.arange(0.0, seconds, 0.1)
    return Turns.of_rates(t, np.full((len(t), 3), rate_rad_s))


def test_a_camera_that_stands_still_is_refused() -> None:
    case, _ = found(0)
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 60.0, 0.1)
    still = seen(rng, t, np.zeros((len(t), 3)), np.eye(3), every=1, sigma_rad=np.radians(0.02))
    with pytest.raises(NotSynchronisedError, match="the camera hardly turned"):
        estimate_time_offset(still, case.body)
    with pytest.raises(NotSynchronisedError, match="the vehicle hardly turned"):
        estimate_time_offset(case.camera, steady(60.0, rate_rad_s=0.1))


@pytest.mark.parametrize("seed", range(10))
def test_a_log_of_another_dive_is_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, t_log = np.arange(0.0, 40.0, 0.02), np.arange(0.0, 240.0, 0.02)
    camera = seen(rng, t, random_rates(rng, t), np.eye(3))
    with pytest.raises(NotSynchronisedError) as refusal:
        estimate_time_offset(camera, Turns.of_rates(t_log, random_rates(rng, t_log)))
    assert "do not explain" in str(refusal.value) or "equally well" in str(refusal.value)


def test_motion_that_repeats_itself_is_refused_with_both_offsets() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 40.0, 0.02)
    sway = np.sin(2.0 * np.pi * t / 4.0)
    rate = 0.1 * np.column_stack([sway, np.roll(sway, 40), np.roll(sway, 90)])
    camera = seen(rng, t, rate, random_rotation(rng))
    with pytest.raises(NotSynchronisedError, match="equally well"):
        estimate_time_offset(camera, Turns.of_rates(t, rate))


def test_a_single_yaw_fits_any_other_unless_the_mounting_is_known() -> None:
    rng = np.random.default_rng(2)
    t, R_cb = np.arange(0.0, 20.0, 0.02), random_rotation(rng)
    yaw = np.column_stack([0.0 * t, 0.0 * t, 0.4 * np.exp(-0.5 * ((t - 10.0) / 2.0) ** 2)])
    camera, body = seen(rng, t, yaw, R_cb), Turns.of_rates(t, yaw)
    with pytest.raises(NotSynchronisedError, match=r"single axis .*\(fusion\.camera\)"):
        estimate_time_offset(camera, body)
    offset = estimate_time_offset(camera, body, R_cb)
    assert offset.offset_s == pytest.approx(0.0, abs=4.0 * offset.sigma_s)


def test_too_little_of_either_is_refused() -> None:
    case, _ = found(0)
    with pytest.raises(NotSynchronisedError, match=r"the log's rotations cover 3\.9 s"):
        estimate_time_offset(case.camera, steady(4.0, 0.1))
    with pytest.raises(NotSynchronisedError, match=r"the video's poses cover 0\.0 s"):
        estimate_time_offset(Turns.join([]), case.body)


def test_a_log_without_rotations_is_refused_by_name() -> None:
    case, _ = found(0)
    depths = [Depth(k, k, "cell", 3.0) for k in range(5)]
    with pytest.raises(InputError, match=r"a\.nmea could not .* neither angular rates nor att"):
        offset_of_log("a.nmea", depths, case.camera)
    rates = [AngularRate(k * 10**8, k * 10**8, "imu", (0.0, 0.0, 0.0)) for k in range(500)]
    with pytest.raises(InputError, match=r"b\.tlog could not .* hardly turned.*--telemetry-offset"):
        offset_of_log("b.tlog", rates, case.camera)


# --- samples of a log -----------------------------------------------------------------------------


def test_samples_are_moved_onto_the_videos_clock() -> None:
    offset = TimeOffset(offset_s=2.0, drift=1e-4, middle_s=10.0)
    depth = Depth(10 * 10**9, 10 * 10**9 + 30, "cell", 3.0)
    utc = UtcTime(20 * 10**9, 20 * 10**9, "gnss/ZDA", 1_795_365_000 * 10**9)
    moved_depth, moved_utc = synchronise_samples([depth, utc], offset)
    assert moved_depth == Depth(12 * 10**9, 12 * 10**9 + 30, "cell", 3.0)
    assert moved_utc.t_ns == 22 * 10**9 + 10**6
    assert isinstance(moved_utc, UtcTime)
    assert moved_utc.utc_ns == utc.utc_ns


def test_a_log_of_attitudes_is_used_where_its_gyro_is_too_slow() -> None:
    rng = np.random.default_rng(8)
    t = np.arange(0.0, 60.0, 0.05)
    rate = random_rates(rng, t)
    camera = seen(rng, t, rate, np.eye(3), every=2)
    quaternions = np.roll(Rotation.from_matrix(orientations(t, rate)).as_quat(), 1, axis=1)
    stamps = [round((at - 5.0) * 1e9) for at in t]
    attitudes = [
        Attitude(ns, ns, "ahrs", (float(w), float(x), float(y), float(z)))
        for ns, (w, x, y, z) in zip(stamps, quaternions, strict=True)
    ]
    slow = [AngularRate(ns, ns, "imu", (0.0, 0.0, 9.0)) for ns in stamps[::20]]
    offset = offset_of_log("a.tlog", [*slow, *attitudes], camera)
    assert offset.offset_s == pytest.approx(5.0, abs=0.02)


# --- a real clip ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reef_clip(shared_data: Path) -> tuple[Turns, Path]:
    clip = shared_data / "reef_clip"
    poses = np.loadtxt(clip / "poses_sfm.tum")
    R_mc = Rotation.from_quat(poses[:, 4:]).as_matrix()
    return Turns.of_orientations(poses[:, 0], R_mc), clip / "gopro_gyro.csv"


@pytest.mark.parametrize("shift_s", [-37.3, 0.5, 120.0])
def test_a_shifted_gyro_of_a_real_clip_is_found_within_a_frame(
    reef_clip: tuple[Turns, Path], shift_s: float
) -> None:
    camera, gyro = reef_clip
    own = offset_of_log(gyro.name, CsvTelemetry.open(gyro).samples(), camera)
    offset = offset_of_log(gyro.name, CsvTelemetry.open(gyro, shift_s).samples(), camera)
    assert offset.offset_s + shift_s == pytest.approx(own.offset_s, abs=1e-3)
    assert own.sigma_s < FRAME_S
    # The camera's own orientation stream is as far from these poses: 0.11 s (docs/telemetry.md).
    assert own.offset_s == pytest.approx(0.108, abs=FRAME_S)
