"""What all settings have in common."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from aquaflow.errors import ConfigError


class Stage(BaseModel):
    """A stage's settings: immutable, and a misspelt key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


AnyStage = TypeVar("AnyStage", bound=Stage)


def validated(model: type[AnyStage], data: dict[str, Any], origin: str) -> AnyStage:
    """Validate a mapping read from ``origin``.

    Raises:
        ConfigError: with the path of the first key that is unknown or out of range.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        path = ".".join(str(part) for part in first["loc"])
        problem = "is not a known key" if first["type"] == "extra_forbidden" else first["msg"]
        raise ConfigError(f"{origin}: '{path}' {problem.lower()}; see `aquaflow config`") from error
