"""Named settings: how much time a run may spend on being right, for a GPU, and the paper's."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

from aquaflow.base.errors import ArgumentError
from aquaflow.config import Config, load_config, parse_config

log = logging.getLogger(__name__)

PRESETS: dict[str, dict[str, Any]] = {
    "fast": {
        "tracking": {"matches": 2500},
        "mapping": {
            "max_gaussians": 80_000,
            "insertion": {"density": 1.0},
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
    "small": {
        "source": {"width": 320},
        "tracking": {
            "keyframe_share": 0.6, "mapping_parallax_widths": 0.25, "matches": 1500,
            "return_candidates": 1, "retrieval": {"candidates": 1},
            "adjustment": {"window": 3, "reach": 1, "points": 100, "at_loops": 0},
        },
        "mapping": {
            "max_gaussians": 20_000,
            "insertion": {"density": 1.0},
            "medium": {"fit_views": 8},
            "optimiser": {
                "steps_keyframe": 4, "steps_mapping": 4, "steps_common": 0, "refine_steps": 400,
            },
        },
    },
    "onboard-gpu": {
        "prior": {"kind": "compact"},
        "mapping": {
            "max_gaussians": 600_000,
            "optimiser": {"steps_keyframe": 30, "steps_mapping": 30, "steps_common": 10},
        },
    },
    "paper": {
        "prior": {"kind": "compact"},
        "mapping": {
            "max_gaussians": 1_200_000,
            "optimiser": {"steps_common": 10},
            "decoder": {
                "enabled": True, "observation": "before_attention", "voxels": {"size_m": 0.2},
            },
        },
    },
    "paper-strict": {
        "prior": {"kind": "compact", "matches": "network"},
        "tracking": {
            "residual": "point", "judge_hidden": False, "return_candidates": 0,
            "crowd_share": 0.7, "recent_keyframes": 0, "reuse_encodings": False,
            "mask_overlays": False,
            "gate": {
                "skip_duplicates": False, "skip_dark": False, "skip_blurred": False,
                "skip_blinded": False,
            },
            "adjustment": {"enabled": False},
            "learned": {"start": True, "moving": False},
            "monitor": {"enabled": False},
        },
        "mapping": {
            "max_gaussians": 1_200_000,
            "insertion": {
                "norm": "l2", "gain": 1.0, "averaged": False, "tau_a": 0.0, "density": 1.0,
                "bare_probability": 0.0, "colour_range": "rendered",
            },
            "optimiser": {"steps_common": 10, "poses": 0.0, "noise_floor": 0.0},
            "medium": {
                "directional": True, "fit": False, "rate": 1e-3, "directional_rate": 1e-3,
            },
            "sunlight": {"enabled": False},
            "decoder": {
                "enabled": True, "optimise_initial": False, "observation": "before_attention",
                "voxels": {"size_m": 0.2},
            },
        },
    },
}  # fmt: skip
"""What each preset changes of the defaults; `aquaflow lab bench` shows what that buys and costs.

The width stays the same in all but ``small``: errors in pictures of different widths cannot be
compared. ``small`` keeps up with 5 pictures a second of a reef on two cores at 40 % and 1.5 GB
(notes/2026-11-speed.md#small-computer).
"""
BY_EFFORT = ("fast", "balanced", "accurate")
"""Presets that were measured on a CPU, least effort first."""
FOR_A_GPU = ("onboard-gpu", "paper", "paper-strict")
"""No figure of theirs was measured on one (docs/tuning.md#presets)."""


def preset(name: str) -> dict[str, Any]:
    """The overrides of the config that ``name`` stands for.

    Raises:
        ArgumentError: there is no such preset.
    """
    if name not in PRESETS:
        raise ArgumentError(f"there is no preset '{name}'; choose {', '.join(PRESETS)}")
    return deepcopy(PRESETS[name])


def load_configured(
    path: Path | None, preset_name: str | None, overrides: dict[str, Any], origin: str
) -> Config:
    """The config file, on top of it the preset, and on top of both the ``overrides``.

    Raises:
        InputError: the file cannot be read.
        ConfigError: an unknown preset or key, or a value out of range, in the file or ``origin``.
    """
    written = {} if path is None else load_config(path).model_dump(exclude_unset=True)
    return parse_config(merge(with_preset(written, preset_name, path), overrides), origin)


def with_preset(written: dict[str, Any], name: str | None, path: Path | None) -> dict[str, Any]:
    """What the file ``path`` sets, and on top of it the preset; a logged sentence names the keys
    that the preset changes. A file cannot win: those that a dive or `aquaflow config` writes hold
    every key, so that a preset on top of one would do nothing.

    Raises:
        ArgumentError: there is no such preset.
    """
    if name is None:
        return written
    changes = preset(name)
    replaced = [f"{key} ({new} for {old})" for key, old, new in _replaced(written, changes)]
    if replaced:
        log.warning("the preset '%s' replaces settings of %s: %s", name, path, ", ".join(replaced))
    return merge(written, changes)


def _replaced(
    written: dict[str, Any], changes: dict[str, Any], stage: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """Each key that ``written`` sets and ``changes`` sets to something else, and both values."""
    for key in filter(written.__contains__, changes):
        old, new = written[key], changes[key]
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _replaced(old, new, f"{stage}{key}.")
        elif old != new:
            yield f"{stage}{key}", old, new


def merge(base: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    """``base`` with ``overrides`` on top, key by key at every depth; None overrides nothing."""
    result = dict(base)
    for key, value in overrides.items():
        if isinstance(value, dict):
            result[key] = merge(result.get(key, {}), value)
        elif value is not None:
            result[key] = value
    return result
