"""The OAK driver's policy, on a device made of a recording."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.drivers.oak.camera import MAX_SAMPLES
from aquaflow.geometry.camera import guess_camera
from aquaflow.sim_drivers.camera_feed import CameraFaults, CameraFeed
from aquaflow.sim_drivers.oak import EXPOSURE_S, GRAVITY_M_S2, ISO, ReplayImuReading
from aquaflow.types import Acceleration, AngularRate, Frame
from tests.drivers.camera_scenes import HEIGHT, WIDTH, Pictures, closing, feed, oak, until

GRAVITY = (0.0, 0.0, -GRAVITY_M_S2)


def samples(count: int, **settings: object) -> list:
    """The first IMU samples of a device at rest."""
    camera, _ = oak(feed(), imu_rate_hz=400, **settings)
    with closing(camera):
        next(camera.frames())
        return list(itertools.islice(camera.samples(), count))


def test_frames_carry_exposure_and_sensitivity() -> None:
    with closing(oak(feed())[0]) as camera:
        frame = next(camera.frames())
    assert isinstance(frame, Frame)
    assert (frame.exposure_s, frame.gain) == (EXPOSURE_S, ISO)


def test_a_jpeg_of_the_device_is_there_for_the_recorder() -> None:
    for encoding, format in (("mjpeg", "jpeg"), ("nv12", None)):
        with closing(oak(feed(), encoding=encoding)[0]) as camera:
            frame = next(camera.frames())
        assert isinstance(frame, Frame)
        assert (None if frame.encoded is None else frame.encoded.format) == format


def test_an_absent_device_is_told_at_once() -> None:
    shots = feed()
    shots.away_until_ns = 1 << 62
    camera, _ = oak(shots)
    with pytest.raises(InputError, match="'front': no OAK camera is plugged in"):
        camera.connect()


def test_calibration_is_that_of_the_first_opening(caplog: pytest.LogCaptureFixture) -> None:
    shots = feed(CameraFaults(disconnect=frozenset({4})))
    camera, device = oak(shots)
    device.calibration = factory = guess_camera(WIDTH, HEIGHT).with_focal_scaled(1.5)
    with closing(camera):
        frames = camera.frames()
        first = next(frames)
        device.calibration = guess_camera(WIDTH, HEIGHT)
        last = until(camera, 9)[-1]
    assert device.openings == 2
    for frame in (first, last):
        assert isinstance(frame, Frame)
        assert frame.camera == factory
    assert "calibration differs from the one in use, which is kept" in caplog.text


def test_jumps_of_time_synchronisation_leave_the_true_moments() -> None:
    faults = CameraFaults(clock_jump_s={6: 4.0, 9: -4.2, 12: 0.2})
    truth: dict[int, int] = {}

    class Remembering(CameraFeed):
        def take(self):
            shot = super().take()
            truth[shot.sequence] = shot.true_ns
            return shot

    camera, _ = oak(Remembering(Pictures(), 100.0, faults))
    with closing(camera):
        seen = until(camera, 20)
    assert all(abs(frame.t_ns - truth[frame.index]) < 5e6 for frame in seen)
    assert camera.counters.stamps_repaired == 6


def test_the_imu_speaks_in_body_axes() -> None:
    for sample in samples(6):
        assert sample.source == "front"
        assert 0 <= sample.arrival_ns - sample.t_ns < 1e9
        if isinstance(sample, Acceleration):
            assert sample.acceleration_m_s2 == pytest.approx(GRAVITY)
        else:
            assert isinstance(sample, AngularRate)
            assert sample.rate_rad_s == (0.0, 0.0, 0.0)


def test_the_mounting_turns_the_imu() -> None:
    first = samples(2, mounting={"pitch_deg": -90.0})
    (down,) = (each for each in first if isinstance(each, Acceleration))
    # The camera's forward points down in the body: what it calls down is the body's backward.
    assert down.acceleration_m_s2 == pytest.approx((GRAVITY_M_S2, 0.0, 0.0))


def test_a_camera_states_the_mounting_that_its_configuration_gives() -> None:
    for given, stated in (({}, None), ({"mounting": {"pitch_deg": -90.0}}, -90.0)):
        with closing(oak(feed(), **given)[0]) as camera:
            found = camera.stated_mounting()
            assert (None if found is None else found.pitch_deg) == stated


def test_the_imu_can_be_switched_off() -> None:
    camera, _ = oak(feed(), imu_rate_hz=0)
    with closing(camera):
        until(camera, 5)
        assert list(camera.samples()) == []


def test_an_imu_whose_axes_are_unknown_is_left_out_and_told() -> None:
    camera, device = oak(feed(), imu_rate_hz=400)
    device.imu_to_camera = None
    with closing(camera):
        until(camera, 5)
        assert list(camera.samples()) == []
    assert camera.notes == ["its IMU is not used: the camera does not report the IMU's axes"]


def test_readings_nobody_fetches_stay_bounded_and_are_counted() -> None:
    camera, _ = oak(feed())
    count = MAX_SAMPLES // 2 + 100
    readings = [ReplayImuReading(t, GRAVITY, t, (0.0, 0.0, 0.0)) for t in range(count)]
    camera.take_imu(readings, np.eye(3), count)
    camera.close()
    assert len(list(camera.samples())) == MAX_SAMPLES
    assert camera.dropped_samples == 200


def test_readings_that_go_back_in_time_are_left_out() -> None:
    camera, _ = oak(feed())
    times = [10, 20, 15, 20, 30, 999]
    readings = [ReplayImuReading(t, GRAVITY, t - 2, (0.0, 0.0, 0.0)) for t in times]
    camera.take_imu(readings, np.eye(3), 40)
    camera.close()
    samples = list(camera.samples())
    for kind, expected in ((Acceleration, [10, 20, 30, 40]), (AngularRate, [8, 18, 28, 40])):
        assert [each.t_ns for each in samples if isinstance(each, kind)] == expected
    assert [each.t_ns for each in samples] == sorted(each.t_ns for each in samples)
