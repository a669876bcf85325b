"""Pressure on the machine: memory, GPU memory, disk, temperature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from aquaflow.config.service import LimitsConfig
from aquaflow.live.recorder.recorder import free_bytes

MB = 1_000_000
"""Bytes of a megabyte, the unit of the settings."""
MILLIDEGREES = 1000.0
"""In a degree: the unit of thermal zones in /sys."""
HOTTEST_C = 150.0
"""Thermal zones that report more are not connected."""
GPU_MEMORY_SHARE = 0.05
"""Of the memory of the GPU that the map lives on, what must stay free."""


class Shortage(Enum):
    """What runs short."""

    MEMORY = "memory"
    GPU_MEMORY = "GPU memory"
    HEAT = "heat"


class Need(NamedTuple):
    """A reason to do less."""

    shortage: Shortage
    reason: str
    """A clause."""


@dataclass(frozen=True)
class Pressure:
    """One reading of the machine's pressure; None where it reports none."""

    free_memory_share: float | None
    disk_free_mb: float | None
    temperature_c: float | None
    gpu_free_share: float | None = None
    """Of the device that the map lives on, what new tensors may have."""

    def need(self, limits: LimitsConfig) -> Need | None:
        """What runs short and is helped by doing less. The disk is not: see ``disk_is_full``."""
        memory, gpu, heat = self.free_memory_share, self.gpu_free_share, self.temperature_c
        if memory is not None and memory < limits.memory_share:
            return Need(Shortage.MEMORY, f"{100 * memory:.0f} % of the memory is left")
        if heat is not None and heat > limits.temperature_c:
            return Need(Shortage.HEAT, f"the machine is {heat:.0f} degC hot")
        if gpu is not None and gpu < GPU_MEMORY_SHARE:
            return Need(Shortage.GPU_MEMORY, f"{100 * gpu:.0f} % of the GPU's memory is left")
        return None

    def disk_is_full(self, limits: LimitsConfig) -> bool:
        """True if checkpoints and recordings must not use more disk."""
        return self.disk_free_mb is not None and self.disk_free_mb < limits.disk_mb


class PressureReader:
    """Reads the pressure from Linux: /proc, /sys, and the unit's own control group; from torch,
    that of the maps' device."""

    def __init__(
        self,
        disk: Path,
        root: Path = Path("/"),
        gpu_free: Callable[[], float | None] = lambda: None,
    ) -> None:
        """``gpu_free``: of the maps' device, as in :class:`Pressure`."""
        self._disk, self._root, self._gpu_free = disk, root, gpu_free

    def __call__(self) -> Pressure:
        return Pressure(
            self._free_memory_share(),
            self._disk_free_mb(),
            self._temperature_c(),
            self._gpu_free(),
        )

    def _free_memory_share(self) -> float | None:
        shares = [share for share in (self._of_machine(), self._of_unit()) if share is not None]
        return min(shares, default=None)

    def _of_machine(self) -> float | None:
        try:
            lines = (self._root / "proc/meminfo").read_text().splitlines()
        except OSError:
            return None
        values = {line.split(":")[0]: int(line.split()[1]) for line in lines if ":" in line}
        total, free = values.get("MemTotal", 0), values.get("MemAvailable")
        return None if free is None or total <= 0 else free / total

    def _of_unit(self) -> float | None:
        """Of what systemd's MemoryMax allows; the kernel kills the unit beyond that."""
        try:
            group = (self._root / "proc/self/cgroup").read_text().rpartition("::")[2].strip()
            folder = self._root / "sys/fs/cgroup" / group.lstrip("/")
            limit = int((folder / "memory.max").read_text())
            used = int((folder / "memory.current").read_text())
            cached = _inactive_file((folder / "memory.stat").read_text())
        except (OSError, ValueError):
            return None  # no limit ("max"), or no control groups of version 2
        return max(limit - used + cached, 0) / limit if limit > 0 else None

    def _disk_free_mb(self) -> float | None:
        try:
            return free_bytes(self._disk) / MB
        except OSError:
            return None

    def _temperature_c(self) -> float | None:
        zones = (self._root / "sys/class/thermal").glob("thermal_zone*/temp")
        found = [value for zone in zones if (value := _degrees(zone)) is not None]
        return max(found, default=None)


def _degrees(zone: Path) -> float | None:
    try:
        value = int(zone.read_text()) / MILLIDEGREES
    except (OSError, ValueError):
        return None
    return value if value < HOTTEST_C else None


def _inactive_file(stat: str) -> int:
    """Bytes of the page cache that the kernel reclaims first."""
    for line in stat.splitlines():
        name, _, value = line.partition(" ")
        if name == "inactive_file":
            return int(value)
    return 0
