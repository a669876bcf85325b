"""Devices that are plugged in, with the lines that make a config use them.

Every driver that can look for its devices registers a function behind the entry point group
``aquaflow.discovery``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any, TypeAlias

DISCOVERY = "aquaflow.discovery"
"""Group of entry points whose functions list the devices of one kind."""


@dataclass(frozen=True)
class FoundDevice:
    """One camera or link."""

    kind: str
    """As in the config: v4l2, oak, serial, can."""
    id: str
    """Stays the same when it is plugged in again."""
    name: str
    detail: str
    """What it delivers, or why it cannot be used now."""
    config: dict[str, Any] = field(default_factory=dict)
    """To paste into the config: of a camera, or of a device's link."""


Discover: TypeAlias = Callable[[], list[FoundDevice]]


@dataclass(frozen=True)
class DiscoveryResult:
    """The devices found, and the errors of drivers that failed."""

    devices: list[FoundDevice]
    problems: list[str]


def discover() -> DiscoveryResult:
    """Ask every installed driver; a driver that fails is reported in ``problems``."""
    devices: list[FoundDevice] = []
    problems: list[str] = []
    for entry in sorted(entry_points(group=DISCOVERY), key=lambda each: each.name):
        try:
            discover_devices: Discover = entry.load()
            devices += discover_devices()
        except Exception as error:  # a broken driver of a site must not hide the others
            problems.append(f"{entry.name}: {error}")
    return DiscoveryResult(devices, problems)
