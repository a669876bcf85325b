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
        """Of what systemd's MemoryMax or a container's limit allows; the kernel kills the unit
        beyond that."""
        try:
            lines = (self._root / "proc/self/cgroup").read_text().splitlines()
        except OSError:
            return None
        groups = [line.split(":", 2) for line in lines if line.count(":") >= 2]
        mounted = self._root / "sys/fs/cgroup"
        shares = [
            share
            for _, kinds, group in groups
            for files in (UNIFIED, OLDER)
            if kinds == files.kinds
            # A container of version 1 is told its group as the machine has it, and sees the root.
            for folder in (mounted / kinds / group.lstrip("/"), mounted / kinds)
            if (share := _free_share(folder, files)) is not None
        ]
        return min(shares, default=None)

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


class GroupFiles(NamedTuple):
    """Names of a version of the kernel's control groups."""

    kinds: str
    """In /proc/self/cgroup, and of the folder."""
    limit: str
    used: str
    cached: str
    """In memory.stat: bytes of the page cache that the kernel reclaims first."""


UNIFIED = GroupFiles("", "memory.max", "memory.current", "inactive_file")
OLDER = GroupFiles(
    "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
)
"""Version 1, as on JetPack 5; without a limit it states one of 8 EiB."""


def _free_share(group: Path, files: GroupFiles) -> float | None:
    """Of a group's memory; None without a limit, and of a group that is not there."""
    try:
        limit = int((group / files.limit).read_text())
        used = int((group / files.used).read_text())
        stat = (group / "memory.stat").read_text()
    except (OSError, ValueError):
        return None
    values = dict(line.split(" ", 1) for line in stat.splitlines() if " " in line)
    cached = int(values.get(files.cached, 0))
    return max(limit - used + cached, 0) / limit if limit > 0 else None
