"""What all settings have in common."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from aquaflow.base.errors import ConfigError, path_of_key, words_of


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
