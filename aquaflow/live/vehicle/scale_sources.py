"""Whether anything that is configured can give the map metres."""

from __future__ import annotations

from aquaflow.base.errors import ConfigError
from aquaflow.config.instruments import DbcConfig
from aquaflow.config.telemetry import AnyDevice, MavlinkConfig
from aquaflow.config.vehicle import VehicleConfig

METRIC_SAMPLES = {"depth", "velocity", "altitude"}
"""Samples of a DBC device that are lengths, or lengths per second."""
METRIC_MESSAGES = {"LOCAL_POSITION_NED", "VFR_HUD", "DISTANCE_SENSOR"}
"""Messages of an autopilot that hold a length, in addition to the external pressure."""


def refuse_without_scale(vehicle: VehicleConfig) -> None:
    """A service that shall send poses must have a source of metres.

    Raises:
        ConfigError: nothing that is configured can ever give the map's scale.
    """
    devices, fusion = vehicle.telemetry.devices.values(), vehicle.fusion
    lengths = bool(fusion.boards) or fusion.lasers is not None
    if fusion.enabled and (lengths or any(_is_metric(device) for device in devices)):
        return
    raise ConfigError(
        "service.pose.enabled: nothing here can give the map's scale in metres, so that no pose "
        "may steer the vehicle; set it to false, or add to telemetry.devices one that measures "
        "depth, velocity or altitude, or set fusion.boards or fusion.lasers; with fusion.enabled"
    )


def _is_metric(device: AnyDevice) -> bool:
    if isinstance(device, MavlinkConfig):
        messages = METRIC_MESSAGES.intersection(device.messages)
        return device.external_pressure is not None or bool(messages)
    if isinstance(device, DbcConfig):
        return any(signal.sample in METRIC_SAMPLES for signal in device.samples)
    return True
