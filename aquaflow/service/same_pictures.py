"""A dive goes on with pictures of the size that it began with: its keyframes have no other."""

from __future__ import annotations

from pathlib import Path

from aquaflow.config import Config, load_config
from aquaflow.errors import AquaFlowError, InputError

SHAPING = ("width", "crop")
"""Settings of ``source`` that the size of a prepared picture follows from."""


def check_same_pictures(dive: Path, config: Config) -> None:
    """Refuse to resume ``dive`` with settings that make other pictures.

    Raises:
        InputError: they do; says which, and what they were.
    """
    try:
        before = load_config(dive / "config.yaml").source
    except AquaFlowError:  # of another version, or lost: then the checkpoint itself must tell
        return
    for name in SHAPING:
        was, asked = getattr(before, name), getattr(config.source, name)
        if was != asked:
            raise InputError(
                f"{dive} was begun with source.{name} {was or 'as the recording has it'}, not "
                f"{asked or 'as the recording has it'}; give the same again, or begin with --new"
            )
