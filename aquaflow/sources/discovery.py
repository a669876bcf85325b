"""Devices that are plugged in or on the vehicle's network, with the lines that make a config use
them.

Every driver that can look for its devices registers a function: behind the entry point group
``aquaflow.discovery`` for those of this computer, behind ``aquaflow.network_discovery`` for others.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeAlias

DISCOVERY = "aquaflow.discovery"
"""Group of entry points whose functions list the devices of one kind."""
NETWORK_DISCOVERY = "aquaflow.network_discovery"
"""Group of those that are given the hosts to ask; without hosts they look nowhere."""
VEHICLE_HOSTS = ("192.168.2.2", "127.0.0.1")
"""A BlueROV2's computer, as BlueOS sets it, and this one, which may be it."""
PATIENCE_S = 8.0
"""Longest wait for all of them together; each takes 3 s at most on a network that works."""


@dataclass(frozen=True)
class FoundDevice:
    """One camera or link."""

    kind: str
    """As in the config: v4l2, oak, stream, serial, can, mavlink, waterlinked_json."""
    id: str
    """Stays the same when it is plugged in again."""
    name: str
    detail: str
    """What it delivers, or why it cannot be used now."""
    config: dict[str, Any] = field(default_factory=dict)
    """To paste into the config: of a camera, a device, or a device's link; empty if it cannot be
    used now."""


Discover: TypeAlias = Callable[[], list[FoundDevice]]
NetworkDiscover: TypeAlias = Callable[[Sequence[str]], list[FoundDevice]]


@dataclass(frozen=True)
class DiscoveryResult:
    """The devices found, and the errors of drivers that failed."""

    devices: list[FoundDevice]
    problems: list[str]


def discover(
    hosts: Sequence[str] = VEHICLE_HOSTS, patience_s: float = PATIENCE_S
) -> DiscoveryResult:
    """Ask every installed driver, all at once; one that fails, or does not end within
    ``patience_s``, is reported in ``problems``. Without ``hosts`` the network is left alone."""
    looks = [_DiscoveryThread(entry, entry.load) for entry in _registered_drivers(DISCOVERY)]
    if hosts:
        looks += [
            _DiscoveryThread(entry, partial(_pass_hosts, entry, hosts))
            for entry in _registered_drivers(NETWORK_DISCOVERY)
        ]
    until_s = time.monotonic() + patience_s
    for look in looks:
        look.thread.join(max(0.0, until_s - time.monotonic()))
    return DiscoveryResult(
        [device for look in looks for device in look.found],
        [problem for look in looks if (problem := look.problem())],
    )


def _registered_drivers(group: str) -> list[EntryPoint]:
    return sorted(entry_points(group=group), key=lambda each: each.name)


def _pass_hosts(entry: EntryPoint, hosts: Sequence[str]) -> Discover:
    look: NetworkDiscover = entry.load()
    return partial(look, hosts)


class _DiscoveryThread:
    """One driver that looks for its devices, in a thread of its own."""

    def __init__(self, entry: EntryPoint, load: Callable[[], Discover]) -> None:
        self.found: list[FoundDevice] = []
        self._name, self._load, self._error = entry.name, load, ""
        self.thread = threading.Thread(target=self._run, name=f"look {entry.name}", daemon=True)
        self.thread.start()

    def problem(self) -> str:
        """A clause if it failed; empty if not."""
        if self.thread.is_alive():
            return f"{self._name}: it did not end"
        return f"{self._name}: {self._error}" if self._error else ""

    def _run(self) -> None:
        try:
            self.found = self._load()()
        except Exception as error:  # a broken driver of a site must not hide the others
            self._error = str(error) or type(error).__name__
