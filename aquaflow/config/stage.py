"""What all settings have in common: refused misspellings, old keys, what is the lab's, devices."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from copy import deepcopy
from typing import Annotated, Any, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aquaflow.base.errors import ArgumentError, ConfigError, path_of_key, words_of

Value = TypeVar("Value")
COMMAND_LINE = "command line"
"""Origin of the values that options set."""
IS_LAB = "a switch of the lab"
"""What ``Lab`` leaves in the metadata of a field."""
Lab: TypeAlias = Annotated[Value, IS_LAB]
"""Type of a key that no user decides: presets, `aquaflow lab ablate`, Python and tests set it."""


class StageConfig(BaseModel):
    """A stage's settings: immutable, and a misspelt key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


AnyStage = TypeVar("AnyStage", bound=StageConfig)


def validate(model: type[AnyStage], data: dict[str, Any], origin: str) -> AnyStage:
    """Validate a mapping read from ``origin``.

    Raises:
        ConfigError: with the path of the first key that is unknown or out of range; from
            ``COMMAND_LINE`` an ArgumentError.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        path = path_of_key(first["loc"])
        key = f"'{path}' " if path else ""  # empty: keys that do not go together
        unknown = first["type"] == "extra_forbidden"
        problem = "is not a known key" if unknown else words_of(first["msg"])
        kind = ArgumentError if origin == COMMAND_LINE else ConfigError
        raise kind(f"{origin}: {key}{problem}; see `aquaflow config`") from error


def stages_of(
    model: type[StageConfig],
) -> Iterator[tuple[str, Any, type[StageConfig] | None, bool]]:
    """Each key of ``model``: its name, its default, the model of a stage below it, and whether it
    is a switch of the lab."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        below = kind if isinstance(kind, type) and issubclass(kind, StageConfig) else None
        yield name, field.default, below, IS_LAB in field.metadata


def changed_in_the_lab(
    model: type[StageConfig], data: Mapping[str, Any], inside: bool = False
) -> Iterator[str]:
    """Paths of the lab's switches that ``data`` sets to anything but their defaults.

    ``inside``: all of ``model`` is below such a switch.
    """
    for name, default, below, is_lab in stages_of(model):
        value = data.get(name)
        if below is not None and isinstance(value, Mapping):
            paths = changed_in_the_lab(below, value, inside or is_lab)
            yield from (f"{name}.{path}" for path in paths)
        elif name in data and (inside or is_lab):
            given = tuple(value) if isinstance(value, list) else value
            if given != default:
                yield name


def without_the_lab(model: type[StageConfig], values: Mapping[str, Any]) -> dict[str, Any]:
    """``values`` of a ``model`` without the lab's switches: what a user decides."""
    shown: dict[str, Any] = {}
    for name, _, below, is_lab in stages_of(model):
        if is_lab or name not in values:
            continue
        value = values[name]
        shown[name] = value if below is None else without_the_lab(below, value)
    return shown


# --------------------------------------------------------------------------------------------------
# What became of keys that a config had in earlier releases; understood for one release.

log = logging.getLogger(__name__)

CONSTANTS: dict[str, Any] = {
    "tracking.gate.duplicate_widths": 0.3 / 480.0,
    "tracking.gate.static_share": 0.8,
    "tracking.gate.min_snr": 2.0,
    "tracking.gate.min_usable": 0.05,
    "tracking.gate.dark_level": 20.0,
    "tracking.gate.blur_loss": 0.065,
    "tracking.gate.blur_memory": 9,
    "tracking.monitor.witnesses": 5,
    "tracking.monitor.sigmas": 5.0,
    "tracking.monitor.min_inlier_share": 0.5,
    "tracking.monitor.rigid_share": 0.8,
    "tracking.monitor.usual_share": 0.65,
    "tracking.crowd_look_loss": 0.05,
    "tracking.return_share": 0.75,
    "tracking.return_widths": 0.03,
    "tracking.min_seen": 0.55,
    "tracking.keyframe_overlap": 0.5,
    "tracking.crowd_overlap": 0.6,
    "tracking.recovered_support": 0.2,
    "tracking.learned.least_triangulated": 0.3,
    "tracking.graph.corroboration": 2,
    "tracking.graph.link_scale_sigma": 0.005,
    "mapping.insertion.covered_alpha": 0.6,
    "mapping.insertion.scale_of_spacing": 0.6,
    "mapping.insertion.max_spacing_widths": 0.1,
    "mapping.insertion.known_sigma": 0.15,
    "mapping.optimiser.newest_share": 0.2,
    "mapping.medium.max_gradient": 0.01,
    "mapping.optimiser.prune_radius_widths": 0.5,
    "mapping.decoder.feature_rate": 4e-3,
    "mapping.sunlight.columns": 24,
    "service.limits.gpu_memory_share": 0.05,
    "telemetry.queue_samples": 10_000,
    "viewer.picture_width": 240,
}
"""Settings of before that are constants now, and their values."""
GONE: dict[str, str] = {
    "mapping.medium.priors.grey_world": "it made the water worse on every clip",
    "mapping.medium.priors.white_backscatter": "it made the water worse on every clip",
}
"""Settings of before whose code went, and why."""
FROM_THE_LAB = "set `lab: true` in the file to keep it from the next release on"


def understood(model: type[StageConfig], data: Mapping[str, Any], origin: str) -> dict[str, Any]:
    """A user's ``data`` as ``model`` takes it: keys of before are taken out, and a logged sentence
    for each says what became of it, where the file wants another value than there is now."""
    current = without_old_keys(data, origin)
    if not current.get("lab"):
        for path in changed_in_the_lab(model, current):
            log.warning(
                "%s: '%s' is a switch of the lab now, no setting of a dive; it is used: %s",
                origin, path, FROM_THE_LAB,
            )  # fmt: skip
    return current


def without_old_keys(data: Mapping[str, Any], origin: str) -> dict[str, Any]:
    """``data`` without keys of before; a logged sentence for each whose value is not used."""
    current = deepcopy(dict(data))
    for path, value in _taken_out(current, CONSTANTS):
        if value != CONSTANTS[path]:
            log.warning(
                "%s: '%s' is a constant now, %s; the file's %s is not used",
                origin, path, CONSTANTS[path], value,
            )  # fmt: skip
    for path, value in _taken_out(current, GONE):
        if value:
            log.warning("%s: '%s' is no key any more and not used: %s", origin, path, GONE[path])
    return current


def _taken_out(data: dict[str, Any], paths: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Remove each of ``paths`` that is in ``data``; the path and its value."""
    for path in paths:
        *stages, key = path.split(".")
        below: Any = data
        for stage in stages:
            below = below.get(stage) if isinstance(below, dict) else None
        if isinstance(below, dict) and key in below:
            yield path, below.pop(key)


# --------------------------------------------------------------------------------------------------
# Settings that every telemetry device has, and where it is mounted.


class MountingConfig(StageConfig):
    """Where a sensor sits in the body frame (forward, right, down)."""

    position_m: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="of the sensor, from the body's origin"
    )
    roll_deg: float = Field(0.0, description="of the sensor's axes in the body, first roll")
    pitch_deg: float = Field(0.0, description="then pitch")
    yaw_deg: float = Field(
        0.0,
        description="then yaw; 180: a DVL that points backwards, unless it turns what it sends",
    )


class DeviceConfig(StageConfig):
    """What every device has."""

    mounting: MountingConfig = MountingConfig()
    silence_s: float | None = Field(
        10.0, gt=0, description="open the link anew after this long without a byte (None: never)"
    )


class PositioningConfig(DeviceConfig):
    """A device that may send fixes on the earth: GNSS, or an acoustic system of the vehicle."""

    position_lag_s: float = Field(
        0.0,
        ge=0,
        le=60,
        description="s that a fix is older than its message says. GNSS receivers: 0.1 to 0.25 "
        "(ArduPilot's GPS1_DELAY_MS ends at 250); acoustic systems more: 0.2 for the sound over "
        "300 m at 1500 m/s, the wait between two pulses, and their filter",
    )
    position_sigma_m: float | None = Field(
        None,
        gt=0,
        description="m, 1 sigma of each horizontal direction of every fix, such as an acoustic "
        "system's data sheet has it; None: as the device states it, else from HDOP",
    )


class Assumptions(StageConfig):
    """What may be assumed where a device measures only part of a quantity.

    A heading without roll and pitch is no attitude. With ``level`` it becomes one: true within the
    few degrees by which a passively stable ROV leans, wrong for gravity on any other vehicle.
    """

    level: bool = Field(False, description="roll and pitch are 0 where nothing measures them")
    no_side_slip: bool = Field(False, description="the vehicle moves only where it points")
    speed_sigma_m_s: float = Field(
        0.2, gt=0, description="m/s, 1 sigma of a velocity that only a speed log measures"
    )
