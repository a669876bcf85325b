"""Why the service works with less than everything: for its page, and for the pilot."""

from __future__ import annotations

from collections.abc import Mapping

from aquaflow.base.errors.failures import Failures
from aquaflow.config.service import LimitsConfig
from aquaflow.live.health import sentences
from aquaflow.live.health.degradation import Degradation, DegradationLevel
from aquaflow.live.health.pressure import Pressure
from aquaflow.live.health.state import ServiceState, ServiceWarning
from aquaflow.live.map_thread import MapThread
from aquaflow.tracking.consistency import InconsistentKeyframe

Devices = Mapping[str, Mapping[str, object]]


def silent_camera(devices: Devices) -> ServiceWarning:
    """Of the camera that maps, which is the first."""
    for name, device in devices.items():
        if device["kind"] == "camera":
            return ServiceWarning(str(device["reason"]), sentences.no_picture(name))
    return ServiceWarning("", sentences.OF_STATE[ServiceState.WAITING])


def inconsistency(found: InconsistentKeyframe | None) -> ServiceWarning | None:
    """Of a finding of the monitor of consistency."""
    return None if found is None else ServiceWarning(str(found), sentences.OF_CAUSE[found.cause])


def of_the_machine(
    degradation: Degradation, pressure: Pressure, limits: LimitsConfig
) -> list[ServiceWarning]:
    """Of memory, heat and disk."""
    troubles, level, need = [], degradation.level, degradation.need
    if level is not DegradationLevel.FULL and need is not None:
        sentence = sentences.doing_less(level, need.shortage)
        troubles.append(ServiceWarning(f"{level.words}: {need.reason}", sentence))
    if pressure.disk_is_full(limits):
        full = f"disk full: {pressure.disk_free_mb:.0f} MB left"
        troubles.append(ServiceWarning(full, sentences.DISK_FULL))
    return troubles


def of_the_stages(maps: MapThread, failures: Failures) -> list[ServiceWarning]:
    """Of what raises again and again."""
    troubles = []
    if maps.failing:
        troubles.append(
            ServiceWarning(f"mapping fails: {maps.last_failure}", sentences.MAPPING_FAILS)
        )
    troubles += [ServiceWarning(each, sentences.STAGE_FAILS) for each in failures.list_repeated()]
    return troubles


def of_the_devices(devices: Devices) -> list[ServiceWarning]:
    """Of links that are silent, and a recorder that ended."""
    troubles = []
    for name, device in devices.items():
        if device["kind"] == "link" and device["state"] != "connected":
            reason = f"link '{name}': {device['reason'] or device['state']}"
            lost = device["state"] == "lost"
            troubles.append(ServiceWarning(reason, sentences.silent_link(name, lost)))
        if device["kind"] == "recorder" and device["state"] != "recording":
            reason = f"not recording: {device['reason']}"
            troubles.append(ServiceWarning(reason, sentences.NOT_RECORDING))
    return troubles
