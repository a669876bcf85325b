"""The configuration: one model per stage, unknown keys refused with their path.

Every default says where it comes from: ``paper``, a peer, or a measurement
(docs/paper.md#deviations, notes/).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from aquaflow.base.errors.regular_file import read_mapping
from aquaflow.config.cameras import PicturesConfig, SourceConfig
from aquaflow.config.mapping import (
    DecoderConfig,
    InsertionConfig,
    LossConfig,
    MappingConfig,
    MediumConfig,
    OptimiserConfig,
    SunlightConfig,
    VoxelConfig,
    WaterPriorsConfig,
)
from aquaflow.config.service import CoverageConfig
from aquaflow.config.stage import StageConfig, understood, validate, without_old_keys
from aquaflow.config.telemetry import FusionConfig
from aquaflow.config.tracking import (
    GateConfig,
    GraphConfig,
    InitialisationConfig,
    MonitorConfig,
    PriorConfig,
    RetrievalConfig,
    TrackingConfig,
    VerificationConfig,
)

__all__ = [
    "Config",
    "CoverageConfig",
    "DecoderConfig",
    "FusionConfig",
    "GateConfig",
    "GraphConfig",
    "InitialisationConfig",
    "InsertionConfig",
    "LossConfig",
    "MappingConfig",
    "MediumConfig",
    "MonitorConfig",
    "OptimiserConfig",
    "PicturesConfig",
    "PriorConfig",
    "RetrievalConfig",
    "SourceConfig",
    "SunlightConfig",
    "TrackingConfig",
    "VerificationConfig",
    "VoxelConfig",
    "WaterPriorsConfig",
    "load_config",
    "parse_config",
    "read_yaml",
]


class Config(StageConfig):
    """Everything a run depends on."""

    lab: bool = Field(
        False, description="True: the file may set the lab's switches (`aquaflow config --all`)"
    )
    seed: int = 0
    threads: int | None = Field(None, ge=1, description="None: every core")
    prior: PriorConfig = PriorConfig()
    source: SourceConfig = SourceConfig()
    tracking: TrackingConfig = TrackingConfig()
    mapping: MappingConfig = MappingConfig()
    fusion: FusionConfig = FusionConfig()
    coverage: CoverageConfig = CoverageConfig()
    pictures: PicturesConfig = PicturesConfig()


def parse_config(data: dict[str, Any], origin: str) -> Config:
    """Validate a mapping read from ``origin``.

    Raises:
        ConfigError: with the path of the first key that is unknown or out of range.
    """
    return validate(Config, without_old_keys(data, origin), origin)


def load_config(path: Path, inside: bool = False) -> Config:
    """Read a YAML config; keys that are absent keep their defaults. ``inside``: of a dive's folder,
    which others may have made, and which holds the lab's switches too.

    Raises:
        InputError: the file cannot be read, or is not YAML.
        ConfigError: a key is unknown or a value out of range.
    """
    data = read_yaml(path, inside)
    return parse_config(data if inside else understood(Config, data, str(path)), str(path))


def read_yaml(path: Path, inside: bool = False) -> dict[str, Any]:
    """The mapping that a YAML file holds; empty for an empty file.

    Raises:
        InputError: the file cannot be read, or is not YAML.
        ConfigError: it holds something else.
    """
    return read_mapping(path, "config", "write `key: value` lines; see `aquaflow config`", inside)
