"""What the depthai backend asks of the library, on a library that only remembers."""

from __future__ import annotations

import logging
from collections.abc import Callable
from datetime import timedelta
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from aquaflow.config.cameras import OakConfig
from aquaflow.drivers.oak import dai_backend
from aquaflow.drivers.oak.dai_backend import DaiBackend, choose
from aquaflow.drivers.oak.messages import imu_readings, picture_of


class QueueError(Exception):
    """Stands for ``dai.MessageQueue.QueueException``."""


@pytest.fixture
def dai(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """The library with one camera plugged in."""
    library = MagicMock()
    library.MessageQueue.QueueException = QueueError
    info = SimpleNamespace(deviceId="1444", name="1.2")
    library.Device.getAllAvailableDevices.return_value = [info]
    library.Device.return_value.getConnectedIMU.return_value = "BMI270"
    library.Device.return_value.getUsbSpeed.return_value = SimpleNamespace(name="SUPER")
    handler = library.Device.return_value.readCalibration.return_value
    handler.getCameraIntrinsics.return_value = [[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]
    handler.getDistortionCoefficients.return_value = [0.0] * 14
    handler.getImuToCameraExtrinsics.side_effect = RuntimeError("no IMU extrinsics")
    monkeypatch.setattr(dai_backend, "depthai", lambda: library)
    return library


def backend(**settings: object) -> DaiBackend:
    return DaiBackend(OakConfig.model_validate({"kind": "oak", **settings}))


def pictures(dai: MagicMock) -> MagicMock:
    camera = dai.Pipeline.return_value.create.return_value.build.return_value
    return camera.requestOutput.return_value.createOutputQueue.return_value


def encoded_frame() -> SimpleNamespace:
    """As ``dai.EncodedFrame``: exposed for 8 ms until 100 s, on the device's clock 7 s."""
    _, data = cv2.imencode(".jpg", np.full((16, 24, 3), 90, np.uint8))
    return SimpleNamespace(
        getData=lambda: data.reshape(-1),
        getExposureTime=lambda: timedelta(milliseconds=8),
        getTimestamp=lambda: timedelta(seconds=100),
        getTimestampDevice=lambda: timedelta(seconds=7),
        getSequenceNum=lambda: 5,
        getSensitivity=lambda: 400,
    )


def test_the_device_keeps_its_calibration_and_leaves_reconnecting_to_us(dai: MagicMock) -> None:
    opened = backend(width=640, height=480)
    device, pipeline = dai.Device.return_value, dai.Pipeline.return_value
    device.setMaxReconnectionAttempts.assert_called_once_with(0)
    pipeline.setAutoCalibrationMode.assert_called_once_with(dai.Pipeline.AutoCalibrationMode.OFF)
    pipeline.start.assert_called_once()
    camera = opened.calibration()
    assert camera is not None
    assert (camera.width, camera.height, camera.fx, camera.cx) == (640, 480, 500.0, 320.5)
    assert opened.imu_to_camera() is None


def test_pictures_are_asked_for_as_the_sensor_sees_them(dai: MagicMock) -> None:
    backend(width=640, height=480, fps=10, socket="CAM_B")
    built = dai.Pipeline.return_value.create.return_value.build
    assert built.call_args.args == (dai.CameraBoardSocket.CAM_B,)
    asked = built.return_value.requestOutput.call_args
    assert asked.args == ((640, 480), dai.ImgFrame.Type.BGR888i)
    assert asked.kwargs == {"fps": 10.0, "enableUndistortion": False}


@pytest.mark.parametrize(
    ("speed", "settings", "encoding"),
    [
        ("SUPER", {}, "bgr"),
        ("SUPER", {"width": 3840, "height": 2160, "fps": 30}, "mjpeg"),
        ("SUPER", {"width": 3840, "height": 2160, "fps": 15}, "nv12"),
        ("HIGH", {}, "nv12"),
        ("HIGH", {"width": 640, "height": 480}, "bgr"),
        ("HIGH", {"fps": 30}, "mjpeg"),
        ("UNKNOWN", {}, "bgr"),
        ("UNKNOWN", {"width": 1920, "height": 1080, "fps": 15}, "nv12"),
        ("FULL", {"width": 640, "height": 480}, "mjpeg"),
        ("HIGH", {"encoding": "bgr"}, "bgr"),
        ("SUPER", {"encoding": "mjpeg"}, "mjpeg"),
    ],
)
def test_pictures_are_encoded_as_the_link_demands(
    speed: str, settings: dict[str, object], encoding: str
) -> None:
    config = OakConfig.model_validate({"kind": "oak", **settings})
    assert choose(config, speed) == encoding


def test_a_slow_link_gets_jpeg_from_the_device_and_the_log_says_so(
    dai: MagicMock, caplog: pytest.LogCaptureFixture
) -> None:
    dai.Device.return_value.getUsbSpeed.return_value = SimpleNamespace(name="HIGH")
    with caplog.at_level(logging.INFO):
        opened = backend(width=1920, height=1080, fps=15)
    assert "the OAK 1444 is on USB 2; pictures come as MJPEG (BGR would be 93 MB/s)" in caplog.text
    node = dai.Pipeline.return_value.create.return_value
    camera, encoder = node.build.call_args_list
    assert node.build.return_value.requestOutput.call_args.args[1] == dai.ImgFrame.Type.NV12
    assert encoder.args == (node.build.return_value.requestOutput.return_value,)
    assert encoder.kwargs["profile"] == dai.VideoEncoderProperties.Profile.MJPEG
    assert encoder.kwargs["frameRate"] == camera.kwargs["sensorFps"] == 15.0
    shown = node.build.return_value.out.createOutputQueue.return_value
    shown.get.return_value = encoded_frame()
    picture = opened.read(0.2)
    assert picture is not None
    assert picture.decode().shape == (16, 24, 3)
    file = picture.jpeg()
    assert file is not None
    assert file.startswith(b"\xff\xd8")


def test_a_damaged_jpeg_is_no_picture() -> None:
    cut = encoded_frame()
    cut.getData = lambda: np.zeros(10, np.uint8)
    with pytest.raises(ValueError, match="damaged JPEG"):
        picture_of(cut, is_jpeg=True).decode()


def test_a_picture_was_taken_in_the_middle_of_its_exposure() -> None:
    picture = picture_of(encoded_frame(), is_jpeg=True)
    assert picture.exposed_ns == 100_000_000_000 - 4_000_000
    assert picture.device_ns == 7_000_000_000 - 4_000_000
    assert picture.exposure_s == pytest.approx(0.008)


def test_gyroscope_and_accelerometer_have_each_their_own_time() -> None:
    def report(t_s: float) -> SimpleNamespace:
        return SimpleNamespace(x=t_s, y=0.0, z=0.0, getTimestamp=lambda: timedelta(seconds=t_s))

    packet = SimpleNamespace(acceleroMeter=report(1.5), gyroscope=report(1.502))
    (reading,) = imu_readings(SimpleNamespace(packets=[packet]))
    assert (reading.acceleration_ns, reading.rate_ns) == (1_500_000_000, 1_502_000_000)
    assert (reading.acceleration_m_s2[0], reading.rate_rad_s[0]) == (1.5, 1.502)


def test_fixed_exposure_is_sent_once_the_camera_runs(dai: MagicMock) -> None:
    backend(exposure_s=0.008, iso=800, white_balance_k=5000)
    control = dai.CameraControl.return_value
    control.setManualExposure.assert_called_once_with(8000, 800)
    control.setManualWhiteBalance.assert_called_once_with(5000)


@pytest.mark.parametrize(
    ("rate_hz", "imu", "asked"), [(200, "BMI270", 1), (0, "BMI270", 0), (200, "", 0)]
)
def test_the_imu_is_asked_for_only_where_there_is_one(
    dai: MagicMock, rate_hz: int, imu: str, asked: int
) -> None:
    dai.Device.return_value.getConnectedIMU.return_value = imu
    opened = backend(imu_rate_hz=rate_hz)
    node = dai.Pipeline.return_value.create.return_value
    assert node.enableIMUSensor.call_count == asked
    node.out.createOutputQueue.return_value.tryGetAll.return_value = []
    assert opened.imu() == []


def test_nothing_yet_is_none(dai: MagicMock) -> None:
    opened = backend()
    pictures(dai).get.return_value = None
    assert opened.read(0.2) is None
    pictures(dai).get.assert_called_once_with(timedelta(milliseconds=200))


def gone_quietly(dai: MagicMock) -> None:
    pictures(dai).get.return_value = None
    dai.Pipeline.return_value.isRunning.return_value = False


def queue_closed(dai: MagicMock) -> None:
    pictures(dai).get.side_effect = QueueError("MessageQueue was closed")


def link_broken(dai: MagicMock) -> None:
    pictures(dai).get.side_effect = RuntimeError("X_LINK_ERROR")


@pytest.mark.parametrize("how", [gone_quietly, queue_closed, link_broken])
def test_a_device_that_goes_is_lost(dai: MagicMock, how: Callable[[MagicMock], Any]) -> None:
    opened = backend()
    how(dai)
    with pytest.raises(ConnectionError, match=r"OAK (is gone|has stopped)"):
        opened.read(0.2)


def test_an_imu_that_goes_is_a_lost_device(dai: MagicMock) -> None:
    opened = backend()
    queue = dai.Pipeline.return_value.create.return_value.out.createOutputQueue.return_value
    queue.tryGetAll.side_effect = QueueError("MessageQueue was closed")
    with pytest.raises(ConnectionError, match="the OAK is gone"):
        opened.imu()


def test_a_device_that_does_not_start_is_given_back(dai: MagicMock) -> None:
    dai.Pipeline.return_value.start.side_effect = RuntimeError("boot failed")
    with pytest.raises(ConnectionError, match="the OAK 1444 does not start: boot failed"):
        backend()
    dai.Device.return_value.close.assert_called_once()


def test_closing_an_unplugged_device_raises_nothing(dai: MagicMock) -> None:
    opened = backend()
    dai.Pipeline.return_value.stop.side_effect = RuntimeError("gone")
    opened.close()
    opened.close()
    dai.Device.return_value.close.assert_called_once()


def test_an_absent_device_is_never_waited_for(dai: MagicMock) -> None:
    dai.Device.getAllAvailableDevices.return_value = []
    with pytest.raises(FileNotFoundError, match="no OAK camera is plugged in"):
        backend()
    dai.Device.assert_not_called()
