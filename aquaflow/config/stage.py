"""What all settings have in common: refused misspellings, and which of them are no user's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from aquaflow.base.errors import ConfigError, path_of_key, words_of

Value = TypeVar("Value")
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
        ConfigError: with the path of the first key that is unknown or out of range.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        path = path_of_key(first["loc"])
        unknown = first["type"] == "extra_forbidden"
        problem = "is not a known key" if unknown else words_of(first["msg"])
        raise ConfigError(f"{origin}: '{path}' {problem}; see `aquaflow config`") from error


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
