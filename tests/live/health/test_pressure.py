"""What the machine says it runs short of, read from files as Linux has them."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.config.service import LimitsConfig
from aquaflow.live.health.pressure import Pressure, PressureReader

LIMITS = LimitsConfig()


def write(root: Path, files: dict[str, str]) -> PressureReader:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return PressureReader(root, root)


def test_memory_is_that_of_the_machine_or_of_the_unit_whichever_is_shorter(
    tmp_path: Path,
) -> None:
    meminfo = {"proc/meminfo": "MemTotal: 1000 kB\nMemFree: 10 kB\nMemAvailable: 500 kB\n"}
    assert write(tmp_path, meminfo)().free_memory_share == pytest.approx(0.5)
    group = "sys/fs/cgroup/system.slice/aquaflow.service"
    limited = {
        "proc/self/cgroup": "0::/system.slice/aquaflow.service\n",
        f"{group}/memory.max": "1000\n",
        f"{group}/memory.current": "950\n",
        f"{group}/memory.stat": "anon 900\ninactive_file 20\n",
    }
    assert write(tmp_path, limited)().free_memory_share == pytest.approx(0.07)
    unlimited = {f"{group}/memory.max": "max\n"}
    assert write(tmp_path, unlimited)().free_memory_share == pytest.approx(0.5)


@pytest.mark.parametrize(
    "folder", ["sys/fs/cgroup/memory/docker/0a1b", "sys/fs/cgroup/memory"]
)  # as the machine sees it, and as the container does
def test_the_limit_of_an_older_control_group_counts_too(tmp_path: Path, folder: str) -> None:
    limited = {
        "proc/self/cgroup": "4:memory:/docker/0a1b\n1:cpu,cpuacct:/docker/0a1b\n0::/\n",
        f"{folder}/memory.limit_in_bytes": "1000\n",
        f"{folder}/memory.usage_in_bytes": "950\n",
        f"{folder}/memory.stat": "cache 70\ninactive_file 1\ntotal_inactive_file 20\n",
    }
    assert write(tmp_path, limited)().free_memory_share == pytest.approx(0.07)
    unlimited = {f"{folder}/memory.limit_in_bytes": "9223372036854771712\n"}
    assert write(tmp_path, unlimited)().free_memory_share == pytest.approx(1.0)


def test_the_hottest_zone_counts_and_zones_that_are_not_wired_up_do_not(tmp_path: Path) -> None:
    zones = {"0": "45000\n", "1": "93500\n", "2": "-256000\n", "3": "655350\n", "4": "broken"}
    files = {f"sys/class/thermal/thermal_zone{n}/temp": text for n, text in zones.items()}
    found = write(tmp_path, files)()
    assert found.temperature_c == pytest.approx(93.5)
    assert "94 degC" in str(found.need(LIMITS))


def test_a_machine_that_tells_nothing_needs_nothing(tmp_path: Path) -> None:
    found = PressureReader(tmp_path / "nowhere", tmp_path)()
    assert (found.free_memory_share, found.disk_free_mb, found.temperature_c) == (None, None, None)
    assert found.need(LIMITS) is None
    assert not found.disk_is_full(LIMITS)


def test_a_disk_is_full_below_its_limit() -> None:
    assert Pressure(None, LIMITS.disk_mb - 1.0, None).disk_is_full(LIMITS)
    assert not Pressure(None, LIMITS.disk_mb + 1.0, None).disk_is_full(LIMITS)
