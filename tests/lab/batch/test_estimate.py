"""The estimate of a dive's memory, against the resident sets in notes/2026-11-speed.md."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.config import Config
from aquaflow.lab.batch.batch import SHARE_OF_FREE, Examined, memory_for_dives_mb, memory_mb


def config(
    width: int | None, mapping: bool = True, gaussians: int = 80_000, **source: int
) -> Config:
    return Config.model_validate(
        {
            "source": {"width": width, **source},
            "mapping": {"enabled": mapping, "max_gaussians": gaussians},
        }
    )


@pytest.mark.parametrize(
    ("peak_mb", "seen", "settings"),
    [
        (596, Examined(1000, 160, 120), config(160)),
        (847, Examined(5000, 160, 120), config(160)),
        (764, Examined(400, 320, 240), config(320, gaussians=20_000)),
        (1323, Examined(20_000, 96, 72), config(96, mapping=False)),
        (221, Examined(40, 160, 120), config(160, mapping=False)),
    ],
)
def test_no_measured_peak_is_above_its_estimate_nor_below_half(
    peak_mb: int, seen: Examined, settings: Config
) -> None:
    assert 0.5 * memory_mb(seen, 0, settings) <= peak_mb <= memory_mb(seen, 0, settings)


def test_frames_that_are_left_out_and_pictures_made_smaller_count() -> None:
    seen = Examined(10_000, 1920, 1080)
    whole = memory_mb(seen, 0, config(480))
    assert memory_mb(seen, 0, config(480, every=10)) < whole
    assert memory_mb(seen, 0, config(240)) < whole
    assert memory_mb(seen, 0, config(None)) == whole


def test_a_recording_that_cannot_be_looked_at_is_judged_by_its_size() -> None:
    assert memory_mb(Examined(), 10**9, config(160)) > memory_mb(Examined(), 10**6, config(160))


def test_free_memory_is_the_machines_or_the_containers_whichever_is_less(tmp_path: Path) -> None:
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9 kB\nMemAvailable:   1000000 kB\n")
    assert memory_for_dives_mb(tmp_path) == round(SHARE_OF_FREE * 1024)
    (tmp_path / "proc/self/cgroup").write_text("0::/unit\n")
    group = tmp_path / "sys/fs/cgroup/unit"
    group.mkdir(parents=True)
    (group / "memory.max").write_text("500000000\n")
    (group / "memory.current").write_text("100000000\n")
    assert memory_for_dives_mb(tmp_path) == round(SHARE_OF_FREE * 400)
