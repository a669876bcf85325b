"""Named settings: how much time a run may spend on being right."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

from aquaflow.config import Config, load_config, parse_config
from aquaflow.errors import ConfigError

PRESETS: dict[str, dict[str, Any]] = {
    "fast": {
        "tracking": {"matches": 2500},
        "mapping": {
            "max_gaussians": 80_000,
            "insertion": {"density": 0.25},
            "optimiser": {
                "steps_keyframe": 8, "steps_mapping": 8, "steps_common": 2, "refine_steps": 400,
            },
        },
    },
    "balanced": {},
    "accurate": {
        "mapping": {
            "max_gaussians": 300_000,
            "optimiser": {
                "steps_keyframe": 30, "steps_mapping": 30, "steps_common": 10,
                "refine_steps": 4000,
            },
        },
    },
}  # fmt: skip
"""What each preset changes of the defaults; `aquaflow bench` shows what that buys and costs.

The width stays the same in all: errors in pictures of different widths cannot be compared.
"""


def preset(name: str) -> dict[str, Any]:
    """The overrides of the config that ``name`` stands for.

    Raises:
        ConfigError: there is no such preset.
    """
    if name not in PRESETS:
        raise ConfigError(f"there is no preset '{name}'; choose {', '.join(PRESETS)}")
    return deepcopy(PRESETS[name])


def configured(
    path: Path | None, preset_name: str | None, overrides: dict[str, Any], origin: str
) -> Config:
    """The config file, on top of it the preset, and on top of both the ``overrides``.

    Raises:
        InputError: the file cannot be read.
        ConfigError: an unknown preset or key, or a value out of range, in the file or ``origin``.
    """
    base = (Config() if path is None else load_config(path)).model_dump()
    if preset_name is not None:
        base = merged(base, preset(preset_name))
    return parse_config(merged(base, overrides), origin)


def merged(base: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    """``base`` with ``overrides`` on top, key by key at every depth; None overrides nothing."""
    result = dict(base)
    for key, value in overrides.items():
        if isinstance(value, dict):
            result[key] = merged(result.get(key, {}), value)
        elif value is not None:
            result[key] = value
    return result
