"""The backend that speaks depthai: messages made on the host, calibration from JSON, no device.

Skipped without the library (366 MB): `pip install 'aquaflow[oak]'`. What needs a device, XLink and
real exposure, no test here reaches.
"""

from __future__ import annotations

import os
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.config.cameras import OakConfig
from aquaflow.drivers.oak import OakCamera
from aquaflow.drivers.oak.dai_backend import (
    LINK_BYTES_S,
    DaiBackend,
    camera_model,
    find_device,
    imu_rotation,
)
from aquaflow.drivers.oak.messages import imu_readings, nanoseconds, picture_of

os.environ.setdefault("DEPTHAI_LEVEL", "off")
dai = pytest.importorskip("depthai", reason="depthai is not installed: pip install aquaflow[oak]")

K = [[800.0, 0.0, 630.0], [0.0, 810.0, 350.0], [0.0, 0.0, 1.0]]
RADTAN = [0.1, -0.2, 0.001, 0.002, 0.05, *[0.0] * 9]
SOCKET = dai.CameraBoardSocket.CAM_A


class NeverOpened:
    getAllAvailableDevices = staticmethod(dai.Device.getAllAvailableDevices)

    def __init__(self, *arguments: object) -> None:
        raise AssertionError("this would search for ten seconds")


def image() -> np.ndarray:
    ramp = np.arange(16 * 24 * 3, dtype=np.uint8).reshape(16, 24, 3)
    return np.ascontiguousarray(ramp)


def message(kind, picture: np.ndarray):
    made = dai.ImgFrame()
    made.setCvFrame(picture, kind)
    made.setSequenceNum(41)
    made.setTimestamp(timedelta(seconds=100, microseconds=250))
    made.setTimestampDevice(timedelta(seconds=7))
    return made


def handler(tmp_path: Path, model: str = "Perspective"):
    """A calibration as it comes from a device: through the JSON of its EEPROM."""
    made = dai.CalibrationHandler()
    made.setBoardInfo("test", "R0")
    made.setCameraIntrinsics(SOCKET, K, (1280, 720))
    coefficients = RADTAN if model == "Perspective" else [0.1, 0.2, 0.3, 0.4]
    made.setDistortionCoefficients(SOCKET, coefficients)
    made.setCameraType(SOCKET, getattr(dai.CameraModel, model))
    made.eepromToJsonFile(tmp_path / "eeprom.json")
    return dai.CalibrationHandler(tmp_path / "eeprom.json")


def test_a_picture_keeps_its_pixels_number_and_times() -> None:
    picture = picture_of(message(dai.ImgFrame.Type.BGR888i, image()))
    assert np.array_equal(picture.decode(), image()[:, :, ::-1])
    assert (picture.sequence, picture.exposed_ns, picture.device_ns) == (
        41, 100_000_250_000, 7_000_000_000,
    )  # fmt: skip


def test_a_grey_picture_becomes_rgb() -> None:
    grey = image()[:, :, 0].copy()
    picture = picture_of(message(dai.ImgFrame.Type.GRAY8, grey))
    assert np.array_equal(picture.decode(), np.repeat(grey[:, :, None], 3, axis=2))


def test_an_exposure_that_the_device_did_not_tell_is_unknown() -> None:
    picture = picture_of(message(dai.ImgFrame.Type.BGR888i, image()))
    assert (picture.exposure_s, picture.iso) == (None, None)


def test_nv12_becomes_rgb() -> None:
    smooth = np.full((16, 24, 3), (200, 90, 40), np.uint8)
    picture = picture_of(message(dai.ImgFrame.Type.NV12, smooth))
    assert np.abs(picture.decode().astype(int) - smooth[:, :, ::-1]).max() <= 3


def test_the_library_takes_the_end_of_exposure_for_its_time() -> None:
    """What ``picture_of`` takes off, since it has no such function for encoded frames."""
    made = message(dai.ImgFrame.Type.BGR888i, image())
    made.cam.exposureTimeUs = 8000
    assert made.getTimestamp(dai.CameraExposureOffset.END) == made.getTimestamp()
    middle = made.getTimestamp(dai.CameraExposureOffset.MIDDLE)
    assert picture_of(made).exposed_ns == nanoseconds(middle)


def test_data_shorter_than_the_picture_is_no_picture() -> None:
    cut = message(dai.ImgFrame.Type.BGR888i, image())
    cut.setData(np.zeros(10, np.uint8))
    with pytest.raises(ValueError, match=r"."):
        picture_of(cut).decode()


def test_messages_pass_a_pipeline_on_the_host() -> None:
    class Source(dai.node.ThreadedHostNode):
        def __init__(self) -> None:
            super().__init__()
            self.out = self.createOutput()

        def run(self) -> None:
            self.out.send(message(dai.ImgFrame.Type.BGR888i, image()))

    with dai.Pipeline(False) as pipeline:
        queue = pipeline.create(Source).out.createOutputQueue(4, False)
        pipeline.start()
        picture = picture_of(queue.get(timedelta(seconds=5)))
    assert np.array_equal(picture.decode(), image()[:, :, ::-1])


def test_a_calibration_is_read_in_our_pixel_convention(tmp_path: Path) -> None:
    camera = camera_model(handler(tmp_path), SOCKET, (1280, 720))
    assert camera is not None
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((800, 810, 630.5, 350.5))
    assert camera.distortion_model == "radtan"
    assert camera.distortion[:5] == pytest.approx(RADTAN[:5])


def test_a_fisheye_calibration_has_four_coefficients(tmp_path: Path) -> None:
    camera = camera_model(handler(tmp_path, "Fisheye"), SOCKET, (1280, 720))
    assert camera is not None
    assert camera.distortion_model == "fisheye"
    assert camera.distortion == pytest.approx((0.1, 0.2, 0.3, 0.4))


def test_a_device_that_was_never_calibrated_has_none() -> None:
    assert camera_model(dai.CalibrationHandler(), SOCKET, (1280, 720)) is None
    assert imu_rotation(dai.CalibrationHandler(), SOCKET) is None


def test_imu_axes_come_from_the_calibration(tmp_path: Path) -> None:
    made = handler(tmp_path)
    turned = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    made.setImuExtrinsics(SOCKET, turned, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert np.allclose(imu_rotation(made, SOCKET), turned)


def test_imu_packets_are_read() -> None:
    def report(t_s: float, x: float):
        return SimpleNamespace(x=x, y=0.0, z=9.8, getTimestamp=lambda: timedelta(seconds=t_s))

    packets = [SimpleNamespace(acceleroMeter=report(1.5, 0.1), gyroscope=report(1.5, 0.2))]
    (reading,) = imu_readings(SimpleNamespace(packets=packets))
    assert (reading.acceleration_ns, reading.rate_ns) == (1_500_000_000, 1_500_000_000)
    assert (reading.acceleration_m_s2[0], reading.rate_rad_s[0]) == (0.1, 0.2)


def test_times_are_exact_after_years() -> None:
    assert nanoseconds(timedelta(days=3000, microseconds=1)) == 259_200_000_000_001_000


def test_without_a_device_it_says_so_and_does_not_search_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Measured: 0.5 s, where opening a device that is not there takes 11.5 s."""
    monkeypatch.setattr(dai, "Device", NeverOpened)
    with pytest.raises(InputError, match="'front': no OAK camera is plugged in; OAK cameras found"):
        OakCamera("front", OakConfig(kind="oak")).connect()
    assert int(os.environ["DEPTHAI_SEARCH_TIMEOUT"]) <= 1000


def test_a_device_is_chosen_by_its_id_or_address() -> None:
    ids = (("A1", "1.2"), ("B2", "10.0.0.9"))
    infos = [SimpleNamespace(deviceId=serial, name=place) for serial, place in ids]
    there = SimpleNamespace(Device=SimpleNamespace(getAllAvailableDevices=lambda: infos))
    assert find_device(there, None) is infos[0]
    assert find_device(there, "B2") is find_device(there, "10.0.0.9") is infos[1]
    with pytest.raises(FileNotFoundError, match="no OAK camera 'C3'; OAK cameras found: A1, B2"):
        find_device(there, "C3")


@pytest.mark.parametrize(
    ("owner", "names"),
    [
        (dai.Device, ["setMaxReconnectionAttempts", "setTimesync", "readCalibration", "close"]),
        (dai.Pipeline, ["setAutoCalibrationMode", "create", "start", "stop", "isRunning"]),
        (dai.Pipeline.AutoCalibrationMode, ["OFF"]),
        (dai.node.Camera, ["build", "requestOutput", "inputControl"]),
        (dai.node.IMU, ["enableIMUSensor", "setBatchReportThreshold", "setMaxBatchReports", "out"]),
        (dai.IMUSensor, ["ACCELEROMETER_RAW", "GYROSCOPE_RAW"]),
        (dai.MessageQueue, ["get", "tryGetAll", "QueueException"]),
        (dai.Device, ["getConnectedIMU", "getUsbSpeed"]),
        (dai.UsbSpeed, list(LINK_BYTES_S)),
        (dai.node.VideoEncoder, ["build", "out"]),
        (dai.VideoEncoderProperties.Profile, ["MJPEG"]),
        (dai.ImgFrame.Type, ["BGR888i", "NV12"]),
        (
            dai.EncodedFrame,
            [
                "getData",
                "getTimestamp",
                "getTimestampDevice",
                "getExposureTime",
                "getSensitivity",
                "getSequenceNum",
            ],
        ),
    ],
)
def test_the_library_has_what_the_backend_calls(owner, names: list[str]) -> None:
    assert [name for name in names if not hasattr(owner, name)] == []


def test_fixed_exposure_and_white_balance_make_a_control_message() -> None:
    backend = DaiBackend.__new__(DaiBackend)
    backend._dai = dai
    config = OakConfig(kind="oak", exposure_s=0.005, iso=400, white_balance_k=5000)
    assert backend._controls(config).getExposureTime() == timedelta(milliseconds=5)
