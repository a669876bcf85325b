"""An OAK camera as a live CameraSource and, for its IMU, as a TelemetrySource."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from aquaflow.config.cameras import OakConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.drivers.capture import RawPicture, UnusablePictureError
from aquaflow.drivers.link import about
from aquaflow.drivers.live import LiveCamera
from aquaflow.drivers.mounting import BodyFrame, Mounting
from aquaflow.drivers.oak.dai_backend import DaiBackend
from aquaflow.geometry.similarity import BODY_FROM_CAMERA
from aquaflow.sources.newest import Newest
from aquaflow.types import Acceleration, AngularRate, CameraModel, EncodedPicture, TelemetrySample

MAX_SAMPLES = 8_000
"""IMU samples kept until fetched, then the oldest go: 10 s of both sensors at 400 Hz."""

log = logging.getLogger(__name__)


class OakCapture:
    """One opening of the device; hands its IMU readings on while pictures are read."""

    def __init__(self, camera: OakCamera, backend: OakBackend) -> None:
        self._owner = camera
        self._backend = backend
        self.camera: CameraModel | None = backend.calibration()
        self.format = ""
        self._rotation = backend.imu_to_camera()
        # Samples in unknown axes are worse than none.
        self.notes: tuple[str, ...] = (
            ("its IMU is not used: the camera does not report the IMU's axes",)
            if self._rotation is None
            else ()
        )

    def read(self, timeout_s: float) -> RawPicture | None:
        picture = self._backend.read(timeout_s)
        arrival_ns = time.monotonic_ns()
        if (readings := self._backend.imu()) and self._rotation is not None:
            self._owner.take_imu(readings, self._rotation, arrival_ns)
        if picture is None:
            return None
        return RawPicture(
            arrival_ns=arrival_ns,
            decode=lambda: _decode(picture),
            exposed_ns=picture.exposed_ns,
            device_ns=picture.device_ns,
            sequence=picture.sequence,
            exposure_s=picture.exposure_s,
            gain=picture.iso,
            received=lambda: _file(picture),
        )

    def close(self) -> None:
        self._backend.close()


class OakCamera(LiveCamera):
    """Pictures with their exposure, and the IMU's samples in body axes.

    The calibration is that of the first opening: the library may rewrite it at run time, and a map
    holds together only under one camera model.
    """

    def __init__(
        self, name: str, config: OakConfig, open_backend: OpenBackend | None = None
    ) -> None:
        self._oak = config
        self._open_backend = open_backend or DaiBackend
        self._mounting, self._body = Mounting(config.mounting), BodyFrame()
        self._samples: Newest[TelemetrySample] = Newest(MAX_SAMPLES, self._drop)
        self.dropped_samples = 0
        """Oldest samples dropped because they were not fetched in time."""
        self._last_imu_ns: dict[type, int] = {Acceleration: -1, AngularRate: -1}
        super().__init__(name, config, self._open_device)

    @classmethod
    def from_config(cls, name: str, config: OakConfig) -> OakCamera:
        """The camera of :func:`aquaflow.sources.open_camera`."""
        return cls(name, config)

    def stated_mounting(self) -> MountingConfig | None:
        """As configured; a camera whose configuration is silent may look anywhere."""
        return self._oak.mounting if "mounting" in self._oak.model_fields_set else None

    def samples(self) -> Iterator[TelemetrySample]:
        """Specific force and angular rate, in the order of arrival, until :meth:`close`."""
        while (sample := self._samples.take()) is not None:
            yield sample

    def close(self) -> None:
        super().close()
        self._samples.end()

    def take_imu(
        self,
        readings: Sequence[ImuReading],
        imu_to_camera: npt.NDArray[np.float64],  # [3, 3]
        arrival_ns: int,
    ) -> None:
        """Queue ``readings`` as samples; those that go back in time are left out."""
        rotation = BODY_FROM_CAMERA @ imu_to_camera
        for reading in readings:
            rate_ns = min(reading.rate_ns, arrival_ns)
            force_ns = min(reading.acceleration_ns, arrival_ns)
            rate = _turn(rotation, reading.rate_rad_s)
            force = _turn(rotation, reading.acceleration_m_s2)
            samples: list[AngularRate | Acceleration] = [
                AngularRate(rate_ns, arrival_ns, self.name, rate),
                Acceleration(force_ns, arrival_ns, self.name, force),
            ]
            self._samples.put_all(self._newer(samples))

    def _newer(self, samples: Sequence[AngularRate | Acceleration]) -> Iterator[TelemetrySample]:
        """Those of the two sensors that go on in time, in their order, in body axes."""
        for sample in sorted(samples, key=attrgetter("t_ns")):
            kind = type(sample)
            if sample.t_ns > self._last_imu_ns[kind]:
                self._last_imu_ns[kind] = sample.t_ns
                yield self._body.refer(sample, self._mounting)

    def _drop(self, sample: TelemetrySample) -> None:
        self.dropped_samples += 1

    def _open_device(self) -> OakCapture:
        capture = OakCapture(self, self._open_backend(self._oak))
        # The camera takes or refuses a size, and never changes it.
        capture.format = f"{self._oak.width} x {self._oak.height} RGB, {self._oak.fps:g} pictures/s"
        if self.camera is not None and capture.camera not in (None, self.camera):
            log.warning(
                "camera '%s': its calibration differs from the one in use, which is kept",
                self.name, extra=about(self.name, "unused"),
            )  # fmt: skip
        return capture


def _turn(
    rotation: npt.NDArray[np.float64],  # [3, 3]
    vector: tuple[float, float, float],
) -> tuple[float, float, float]:
    x, y, z = (float(each) for each in rotation @ np.array(vector))
    return x, y, z


def _file(picture: OakPicture) -> EncodedPicture | None:
    data = picture.jpeg()
    return None if data is None else EncodedPicture("jpeg", data)


def _decode(picture: OakPicture) -> npt.NDArray[np.uint8]:
    try:
        return picture.decode()
    except ValueError as error:
        raise UnusablePictureError(f"cannot be decoded: {error}") from error


# --------------------------------------------------------------------------------------------------
# The functions of an OAK camera that :class:`aquaflow.drivers.oak.camera.OakCamera` needs.
#
# ``DaiBackend`` speaks to the device; the replay backend in sim_drivers needs none.


class OakPicture(Protocol):
    """A picture as the device delivered it."""

    exposed_ns: int
    """Middle of the exposure, CLOCK_MONOTONIC, as the library's time synchronisation has it."""
    device_ns: int
    """The same moment on the device's clock."""
    sequence: int
    exposure_s: float | None
    iso: float | None

    def decode(self) -> npt.NDArray[np.uint8]:
        """[H, W, 3] RGB; raises ValueError if the data makes no picture."""
        ...

    def jpeg(self) -> bytes | None:
        """The file that the device made; None where it sends pixels."""
        ...


class ImuReading(Protocol):
    """Accelerometer and gyroscope, each with its moment, in the axes of the IMU."""

    acceleration_ns: int
    acceleration_m_s2: tuple[float, float, float]
    rate_ns: int
    rate_rad_s: tuple[float, float, float]


class OakBackend(Protocol):
    """One opening of one camera; every call raises OSError when the device is gone."""

    def calibration(self) -> CameraModel | None:
        """Of the pictures' size; None if the device carries none."""
        ...

    def imu_to_camera(self) -> npt.NDArray[np.float64] | None:
        """[3, 3] rotation of the IMU's axes into the camera's (right, down, forward)."""
        ...

    def read(self, timeout_s: float) -> OakPicture | None:
        """The next picture; None when ``timeout_s`` passed without one."""
        ...

    def imu(self) -> Sequence[ImuReading]:
        """Readings since the last call."""
        ...

    def close(self) -> None: ...


OpenBackend: TypeAlias = Callable[[OakConfig], OakBackend]
"""Finds and starts the camera; raises OSError with a sentence while it is not there."""
