"""The OAK backend on Luxonis' depthai library, version 3.

Not reachable without a device: XLink itself and real exposure. Everything else is tested with
messages made on the host.
"""

from __future__ import annotations

import contextlib
import logging
import os
from datetime import timedelta
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import load
from aquaflow.config.cameras import OakConfig
from aquaflow.drivers.oak.messages import DaiImuReading, DaiPicture, imu_readings, picture_of
from aquaflow.geometry.camera import DistortionModel
from aquaflow.types import CameraModel

SEARCH_MS = 500
"""Longest search; the library's own 10 s are long if only the cable is missing."""

PICTURE_QUEUE = 4
"""Pictures; the queue drops the oldest, so a short one keeps what is read fresh."""
IMU_QUEUE = 200
"""Half a second at 400 Hz; pictures are read at least five times a second."""

TIMESYNC_PERIOD = timedelta(seconds=5)
TIMESYNC_SAMPLES = 10
"""depthai's own defaults (DeviceBase.hpp), stated so that no later version changes them."""

log = logging.getLogger(__name__)


def depthai() -> Any:
    """The library, configured for little output and a short search."""
    os.environ.setdefault("DEPTHAI_LEVEL", "error")
    os.environ.setdefault("DEPTHAI_SEARCH_TIMEOUT", str(SEARCH_MS))
    return load("depthai", "an OAK camera", extra="oak")


def find_device(dai: Any, wanted: str | None) -> Any:
    """The DeviceInfo of the camera with this id or address, or of the first.

    Raises:
        FileNotFoundError: it is not there.
    """
    found = dai.Device.getAllAvailableDevices()
    for info in found:
        if wanted is None or wanted in {info.deviceId, info.name}:
            return info
    missing = "no OAK camera is plugged in" if wanted is None else f"no OAK camera '{wanted}'"
    there = ", ".join(str(info.deviceId) for info in found) or "none"
    raise FileNotFoundError(f"{missing}; OAK cameras found: {there}")


class DaiBackend:
    """A pipeline of one camera and its IMU, running on the device."""

    def __init__(self, config: OakConfig) -> None:
        """Find the device and start it.

        Raises:
            FileNotFoundError: it is not there.
            ConnectionError: it is there and does not start.
            InputError: depthai is not installed.
        """
        self._dai = dai = depthai()
        info = find_device(dai, config.device)
        self._id = info.deviceId
        self._device: Any = None
        self._pipeline: Any = None
        try:
            self._device = dai.Device(info)
            self._pipeline = dai.Pipeline(self._device)
            self._start(config)
        except (RuntimeError, dai.MessageQueue.QueueException) as error:
            self.close()
            raise ConnectionError(f"the OAK {info.deviceId} does not start: {error}") from error

    def calibration(self) -> CameraModel | None:
        return self._calibration

    def imu_to_camera(self) -> npt.NDArray[np.float64] | None:
        return self._imu_rotation

    def read(self, timeout_s: float) -> DaiPicture | None:
        try:
            message = self._pictures.get(timedelta(seconds=timeout_s))
        except (RuntimeError, self._dai.MessageQueue.QueueException) as error:
            raise ConnectionError(f"the OAK is gone: {error}") from error
        if message is None and not self._pipeline.isRunning():
            raise ConnectionError("the OAK has stopped")
        return None if message is None else picture_of(message, self._encoding == "mjpeg")

    def imu(self) -> list[DaiImuReading]:
        if self._readings is None:
            return []
        try:
            return [
                reading
                for message in self._readings.tryGetAll()
                for reading in imu_readings(message)
            ]
        except (RuntimeError, self._dai.MessageQueue.QueueException) as error:
            raise ConnectionError(f"the OAK is gone: {error}") from error

    def close(self) -> None:
        pipeline, self._pipeline = self._pipeline, None
        device, self._device = self._device, None
        # An unplugged device can be neither stopped nor closed.
        with contextlib.suppress(RuntimeError):
            if pipeline is not None:
                pipeline.stop()
        with contextlib.suppress(RuntimeError):
            if device is not None:
                device.close()

    def _start(self, config: OakConfig) -> None:
        dai = self._dai
        # Our own supervisor reconnects: it counts, and it keeps calibration and indices.
        self._device.setMaxReconnectionAttempts(0)
        self._device.setTimesync(TIMESYNC_PERIOD, TIMESYNC_SAMPLES, True)
        self._pipeline.setAutoCalibrationMode(dai.Pipeline.AutoCalibrationMode.OFF)
        socket = getattr(dai.CameraBoardSocket, config.socket)
        handler = self._device.readCalibration()
        size = (config.width, config.height)
        self._calibration = camera_model(handler, socket, size)
        self._imu_rotation = imu_rotation(handler, socket)
        camera = self._pipeline.create(dai.node.Camera).build(socket, sensorFps=config.fps)
        self._pictures = self._output(camera, config).createOutputQueue(PICTURE_QUEUE, False)
        control = camera.inputControl.createInputQueue()
        self._readings = self._imu_queue(config.imu_rate_hz)
        self._pipeline.start()
        control.send(self._controls(config))

    def _output(self, camera: Any, config: OakConfig) -> Any:
        """The camera's pictures, encoded as its link demands."""
        dai, speed = self._dai, self._device.getUsbSpeed().name
        self._encoding = choose(config, speed)
        log.info("the OAK %s is %s", self._id, describe_choice(config, speed, self._encoding))
        kinds = dai.ImgFrame.Type
        output = camera.requestOutput(
            (config.width, config.height),
            kinds.BGR888i if self._encoding == "bgr" else kinds.NV12,
            fps=config.fps,
            enableUndistortion=False,
        )
        if self._encoding != "mjpeg":
            return output
        profile = dai.VideoEncoderProperties.Profile.MJPEG
        encoder = self._pipeline.create(dai.node.VideoEncoder)
        return encoder.build(
            output, frameRate=config.fps, profile=profile, quality=JPEG_QUALITY
        ).out

    def _imu_queue(self, rate_hz: int) -> Any:
        """The IMU's queue; None if not configured, or the camera has no IMU (OAK-1, OAK-D Lite)."""
        dai = self._dai
        if rate_hz == 0 or not self._device.getConnectedIMU():
            return None
        imu = self._pipeline.create(dai.node.IMU)
        imu.enableIMUSensor([dai.IMUSensor.ACCELEROMETER_RAW, dai.IMUSensor.GYROSCOPE_RAW], rate_hz)
        imu.setBatchReportThreshold(1)
        imu.setMaxBatchReports(10)
        return imu.out.createOutputQueue(IMU_QUEUE, False)

    def _controls(self, config: OakConfig) -> Any:
        control = self._dai.CameraControl()
        if config.exposure_s is not None and config.iso is not None:
            control.setManualExposure(round(config.exposure_s * 1e6), config.iso)
        if config.white_balance_k is not None:
            control.setManualWhiteBalance(config.white_balance_k)
        return control


# --------------------------------------------------------------------------------------------------
# The calibration that an OAK carries in its EEPROM, as a CameraModel.

HALF_PIXEL = 0.5
"""OpenCV puts the centre of the first pixel at 0, AquaFlow at 0.5."""


def camera_model(handler: Any, socket: Any, size: tuple[int, int]) -> CameraModel | None:
    """From a ``dai.CalibrationHandler``, for pictures of exactly ``size`` (width, height).

    It was made in air: behind a flat port in water it is wrong, and ``calibration`` in the config
    replaces it. None if the device was never calibrated.
    """
    try:
        K = handler.getCameraIntrinsics(socket, *size)
        coefficients = handler.getDistortionCoefficients(socket)
        fisheye = handler.getDistortionModel(socket).name == "Fisheye"
    except RuntimeError:
        return None
    if not np.all(np.isfinite(K)) or K[0][0] <= 0.0 or K[1][1] <= 0.0:
        return None
    model: DistortionModel = "fisheye" if fisheye else "radtan"
    return CameraModel(
        *size,
        K[0][0],
        K[1][1],
        K[0][2] + HALF_PIXEL,
        K[1][2] + HALF_PIXEL,
        distortion_model=model,
        distortion=tuple(coefficients[:4] if fisheye else coefficients),
    )


def imu_rotation(handler: Any, socket: Any) -> npt.NDArray[np.float64] | None:
    """[3, 3] rotation of IMU axes into camera axes; None if the device does not know."""
    try:
        transform = np.array(handler.getImuToCameraExtrinsics(socket), dtype=np.float64)
    except RuntimeError:
        return None
    rotation = transform[:3, :3]
    known = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    return rotation if known else None


# --------------------------------------------------------------------------------------------------
# How pictures come from an OAK: whole, with less colour, or as JPEG, by what its link carries.
#
# Bytes a second are those of the pictures; the figures of links are what is left of their nominal
# rate for one camera beside the IMU.

Encoding: TypeAlias = Literal["bgr", "nv12", "mjpeg"]

BYTES_PER_PIXEL: dict[Encoding, float] = {"bgr": 3.0, "nv12": 1.5}
"""Of those that are not compressed, the best first. NV12 has one colour for four pixels, as the
sensor's own mosaic and every JPEG do."""

LINK_BYTES_S = {
    "SUPER_PLUS": 300e6,
    "SUPER": 300e6,
    "HIGH": 28e6,
    "UNKNOWN": 60e6,
}
"""By the name of ``dai.UsbSpeed``: USB 3 of 5 Gbit/s, USB 2 of 480 Mbit/s, of which some 35 MB/s
arrive; UNKNOWN is a camera on the network, whose own port has 1 Gbit/s. Slower than all of these
are USB 1's LOW and FULL."""
SLOWEST_BYTES_S = 1e6

NAMES = {"SUPER_PLUS": "USB 3", "SUPER": "USB 3", "HIGH": "USB 2", "UNKNOWN": "the network"}

JPEG_QUALITY = 95
"""Percent; a tenth of BGR's bytes, and finer than what tracking sees."""


def choose(config: OakConfig, speed: str) -> Encoding:
    """As configured, else the best that a link of this ``dai.UsbSpeed`` carries."""
    if config.encoding != "auto":
        return config.encoding
    room = LINK_BYTES_S.get(speed, SLOWEST_BYTES_S)
    for encoding, size in BYTES_PER_PIXEL.items():
        if _rate(config, size) <= room:
            return encoding
    return "mjpeg"


def describe_choice(config: OakConfig, speed: str, encoding: Encoding) -> str:
    """The choice in words, for the log."""
    link = NAMES.get(speed, "USB 1")
    raw = _rate(config, BYTES_PER_PIXEL["bgr"]) * 1e-6
    return f"on {link}; pictures come as {encoding.upper()} (BGR would be {raw:.0f} MB/s)"


def _rate(config: OakConfig, bytes_per_pixel: float) -> float:
    """Bytes a second."""
    return config.width * config.height * config.fps * bytes_per_pixel
