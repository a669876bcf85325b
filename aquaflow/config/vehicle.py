"""The settings of a vehicle: its cameras and telemetry, in addition to those of mapping."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from aquaflow.config import Config, read_yaml
from aquaflow.config.cameras import CameraConfig
from aquaflow.config.presets import with_preset
from aquaflow.config.service import RecordingConfig, ServiceConfig, ViewerConfig
from aquaflow.config.stage import understood, validate
from aquaflow.config.telemetry import TelemetryConfig


class VehicleConfig(Config):
    """What ``aquaflow record`` and ``aquaflow run`` read: deploy/config/*.yaml."""

    cameras: dict[str, CameraConfig] = Field({}, description="by the name that logs call them")
    telemetry: TelemetryConfig = TelemetryConfig()
    recording: RecordingConfig = RecordingConfig()
    service: ServiceConfig = ServiceConfig()
    viewer: ViewerConfig = ViewerConfig()


def load_vehicle(path: Path | None, preset_name: str | None = None) -> VehicleConfig:
    """Read a YAML config, if one is given, with a preset on top of it.

    Raises:
        InputError: the file cannot be read, or is not YAML.
        ConfigError: an unknown preset or key, or a value out of range.
    """
    written = {} if path is None else understood(VehicleConfig, read_yaml(path), str(path))
    return validate(
        VehicleConfig, with_preset(written, preset_name, path), str(path or preset_name)
    )


def load_any(path: Path) -> Config:
    """Read a YAML config of either kind: a vehicle's if it has a key that only those have.

    Raises:
        InputError: the file cannot be read, or is not YAML.
        ConfigError: a key is unknown or a value out of range.
    """
    written = read_yaml(path)
    only_vehicles = VehicleConfig.model_fields.keys() - Config.model_fields.keys()
    model = VehicleConfig if only_vehicles & written.keys() else Config
    return validate(model, understood(model, written, str(path)), str(path))


def looking_in(vehicle: VehicleConfig, site: Path) -> VehicleConfig:
    """The same vehicle, whose dives are looked for in the earlier one in the folder ``site``."""
    dive = vehicle.service.dive.model_copy(update={"site": site})
    service = vehicle.service.model_copy(update={"dive": dive})
    return vehicle.model_copy(update={"service": service})
