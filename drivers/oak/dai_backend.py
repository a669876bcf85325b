"""The OAK backend on Luxonis' depthai library, version 3.

Not reachable without a device: XLink itself and real exposure. Everything else is tested with
messages made on the host.
"""

from __future__ import annotations

import contextlib
import logging
import os
from datetime import timedelta
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors.extra import load
from aquaflow.config.cameras import OakConfig
from aquaflow.drivers.oak.calibration import camera_model, imu_rotation
from aquaflow.drivers.oak.encoding import JPEG_QUALITY, chosen, said
from aquaflow.drivers.oak.messages import DaiImuReading, DaiPicture, imu_readings, picture_of
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
        self._encoding = chosen(config, speed)
        log.info("the OAK %s is %s", self._id, said(config, speed, self._encoding))
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
