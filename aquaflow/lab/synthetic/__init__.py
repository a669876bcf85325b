"""Synthetic dives: a procedural sea floor seen through known water, with the truth about it all.

Names are loaded when first used, so that importing the config costs neither torch nor OpenCV.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aquaflow.lab.synthetic.config import SyntheticConfig
    from aquaflow.lab.synthetic.dive import SimulatedDive, simulate, write_dive
    from aquaflow.lab.synthetic.telemetry import read_telemetry
    from aquaflow.lab.synthetic.truth import Truth, read_truth
    from aquaflow.lab.synthetic.water import WATER_TYPES, Medium

__all__ = [
    "WATER_TYPES",
    "Medium",
    "SimulatedDive",
    "SyntheticConfig",
    "Truth",
    "read_telemetry",
    "read_truth",
    "simulate",
    "write_dive",
]

_HOMES = {
    "Medium": "water",
    "SimulatedDive": "dive",
    "SyntheticConfig": "config",
    "Truth": "truth",
    "WATER_TYPES": "water",
    "read_telemetry": "telemetry",
    "read_truth": "truth",
    "simulate": "dive",
    "write_dive": "dive",
}
"""Module of each public name, imported when it is first asked for."""


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
