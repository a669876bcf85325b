"""How the mapping camera of a live dive sits in the vehicle, from whatever states it first."""

from __future__ import annotations

from collections.abc import Mapping

from aquaflow.config import Config
from aquaflow.config.service import ServiceConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.live.recorder.recorder import Recorder
from aquaflow.sources import CameraSource, mounting_of


def camera_mounting(
    config: Config, service: ServiceConfig, camera: object
) -> MountingConfig | None:
    """``fusion.camera``, else what ``camera`` (or its feed) states, else ``service.pose.mounting``
    where poses are sent; None: unknown.

    Raises:
        InputError, ConfigError: the camera states one that cannot be read.
    """
    pose = service.pose
    return config.fusion.camera or mounting_of(camera) or (pose.mounting if pose.enabled else None)


def record_mountings(
    recorder: Recorder, vehicle: VehicleConfig, cameras: Mapping[str, CameraSource]
) -> None:
    """State in a recording how the cameras sit, as far as the vehicle's configuration says it."""
    mapped = vehicle.service.camera or next(iter(cameras), None)
    for name, camera in cameras.items():
        known = mounting_of(camera)
        if name == mapped:
            known = camera_mounting(vehicle, vehicle.service, camera)
        recorder.record_mounting(name, known)
