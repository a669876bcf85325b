"""The feed that a config or a path describes."""

from __future__ import annotations

import time
from pathlib import Path

from aquaflow.base.errors import ConfigError
from aquaflow.base.errors.failures import Failures
from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.log import EarlyRecords
from aquaflow.live.feed import LiveFeed, PlaybackFeed
from aquaflow.live.mounting import record_mountings
from aquaflow.live.recorder.recorder import Recorder
from aquaflow.recordings.playback import Playback
from aquaflow.sources import open_camera, open_links, open_recording, telemetry_reader
from aquaflow.types import CameraModel


def devices(vehicle: VehicleConfig) -> LiveFeed:
    """The vehicle's cameras and links, with a recorder if ``service.record`` is set. A camera that
    is not there yet is waited for.

    Raises:
        ConfigError: ``service.camera`` names none of the cameras.
        InputError: a driver or the library that it needs is not installed.
    """
    EarlyRecords().attach()  # links are opened before the dive has a folder
    name = vehicle.service.camera or next(iter(vehicle.cameras))
    if name not in vehicle.cameras:
        known = ", ".join(vehicle.cameras)
        raise ConfigError(f"service.camera is '{name}'; the cameras are: {known}")
    cameras = {key: open_camera(key, config) for key, config in vehicle.cameras.items()}
    recorder = _recorder(vehicle) if vehicle.service.record else None
    if recorder is not None:
        record_mountings(recorder, vehicle, cameras)
    tap = None if recorder is None else recorder.raw
    links = open_links(vehicle.telemetry, tap) if vehicle.telemetry.devices else None
    return LiveFeed(name, cameras, links, vehicle.source, recorder)


def _recorder(vehicle: VehicleConfig) -> Recorder:
    """One folder for each start of the service: a recording is never appended to."""
    folder = vehicle.service.dives / time.strftime("recording-%Y%m%d-%H%M%S")
    return Recorder(folder, vehicle.recording)


def recording(
    path: Path,
    vehicle: VehicleConfig,
    speed: float = 1.0,
    calibration: CameraModel | None = None,
) -> PlaybackFeed:
    """The recording at ``path``, played back in real time, ``speed`` times as fast.

    Raises:
        InputError: nothing is there, or no installed source reads it.
    """
    camera = open_recording(path, fps=vehicle.source.fps)
    reader = telemetry_reader(path)
    telemetry = [] if reader is None else [reader.open(path)]
    failures = Failures()
    playback = Playback(camera, telemetry, speed, failures=failures)
    known = calibration or camera.camera
    return PlaybackFeed(playback, vehicle.source, known, camera.name_of, camera.notes, failures)
