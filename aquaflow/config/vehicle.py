"""The settings of a vehicle: its cameras and telemetry, in addition to those of mapping."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from aquaflow.config import Config, read_yaml
from aquaflow.config.cameras import CameraConfig
from aquaflow.config.recording import RecordingConfig
from aquaflow.config.service import ServiceConfig
from aquaflow.config.stage import validated
from aquaflow.config.telemetry import TelemetryConfig
from aquaflow.config.viewer import ViewerConfig


class VehicleConfig(Config):
    """What ``aquaflow record`` and ``aquaflow run`` read: deploy/config/*.yaml."""

    cameras: dict[str, CameraConfig] = Field({}, description="by the name that logs call them")
    telemetry: TelemetryConfig = TelemetryConfig()
    recording: RecordingConfig = RecordingConfig()
    service: ServiceConfig = ServiceConfig()
    viewer: ViewerConfig = ViewerConfig()


def load_vehicle(path: Path) -> VehicleConfig:
    """Read a YAML config.

    Raises:
        InputError: the file cannot be read, or is not YAML.
        ConfigError: a key is unknown or a value out of range.
    """
    return validated(VehicleConfig, read_yaml(path), str(path))
