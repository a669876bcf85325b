"""The MAVLink dialect: message definitions, checksum seeds and unpackers, by pymavlink."""

from __future__ import annotations

from typing import Any

from aquaflow.base.errors import load

DIALECT = "pymavlink.dialects.v20.ardupilotmega"
"""ArduPilot's messages; they include the common ones, which PX4 sends too."""


def dialect(needed_by: str) -> Any:
    """The dialect's module; InputError if pymavlink is not installed."""
    return load(DIALECT, needed_by)
