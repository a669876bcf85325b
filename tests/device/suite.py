"""The whole ci suite on the pretended device, on the CPU, and on the CPU without compiled kernels.

``python -m tests.device.suite FOLDER`` maps every scene and prints the table of
notes/measurements.md#pretended-device. On the device and on the CPU without compiled kernels the
same operations are made in the same order; the compiled ones round otherwise, and a map's
optimisation makes of that what a change of the number of threads makes too.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from aquaflow.base.errors import NotMappedError
from aquaflow.lab.bench.ci_suite import ci_scenes
from aquaflow.lab.bench.job import BenchJob
from aquaflow.lab.bench.scene import BenchmarkScene
from aquaflow.lab.bench.worker import perform
from aquaflow.render.contract import CPU
from aquaflow.render.transfer_counts import transfers
from tests.device.device_scenes import without_kernels
from tests.device.gsplats_place import machine_with
from tests.pretended_device import PRETENDED, pretended_device

PRESET = "fast"
VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {"threads": 1},
    "neural": {
        "threads": 1,
        "mapping": {"decoder": {"enabled": True}, "sunlight": {"enabled": True}},
    },
}
"""What is changed of the preset."""
NUMBERS = ("psnr", "ate_pct_sim3", "gaussians", "depth_absrel", "restored_psnr")
"""Compared; null where a scene has no truth of it, as on the CPU."""
SHOWN = ("psnr", "ate_pct_sim3", "gaussians")
COMPILED, PLAIN_TORCH, DEVICE = "compiled kernels", "torch", "device"
PLACES = (COMPILED, PLAIN_TORCH, DEVICE)


@dataclass(frozen=True)
class Mapped:
    """One scene, mapped in one place; of one that cannot be mapped there are no numbers."""

    folder: Path
    numbers: dict[str, Any]
    moved: Counter[str]
    """Tensors by the name of the transfer."""
    strays: int
    """Tensors that something else moved."""


def scenes(cache: Path) -> list[BenchmarkScene]:
    return ci_scenes(cache, lambda *_: None)


def map_scene(scene: BenchmarkScene, variant: str, place: str, out: Path) -> Mapped:
    """As ``aquaflow lab bench`` does in its worker, but in this process."""
    name = "".join(letter if letter.isalnum() else "_" for letter in scene.name)
    folder = out / f"{name}-{variant}-{place.replace(' ', '_')}"
    job = BenchJob(scene, PRESET, str(folder), overrides=VARIANTS[variant])
    before, row = Counter(transfers()), dict.fromkeys(NUMBERS)
    with _in(place) as strays:
        try:
            row = perform(job)
            assert not row["failures"], row["failures"]
            assert row["device"] == (PRETENDED if place == DEVICE else CPU).type
        except NotMappedError:
            pass
    moved = Counter(transfers()) - before
    return Mapped(folder, {key: row[key] for key in NUMBERS}, moved, sum(strays.values()))


@contextmanager
def _in(place: str) -> Iterator[Counter[str]]:
    """The machine; gives what moved tensors that should not."""
    with pytest.MonkeyPatch.context() as patch:
        if place != COMPILED:
            without_kernels(patch)
        if place != DEVICE:
            with machine_with(CPU):
                yield Counter()
            return
        with pretended_device() as device, machine_with(PRETENDED):
            yield device.strays


def difference(a: dict[str, Any], b: dict[str, Any], key: str) -> float | None:
    """Relative; None where there is nothing to compare."""
    if a[key] is None or b[key] is None:
        assert a[key] is b[key] is None
        return None
    return float(abs(a[key] - b[key]) / max(abs(b[key]), 1e-12))


def row_of(scene: str, variant: str, mapped: dict[str, Mapped]) -> str:
    """A row of the table."""
    there = mapped[DEVICE]
    cells = [scene, variant, str(there.numbers["gaussians"])]
    for place in (PLAIN_TORCH, COMPILED):
        found = [difference(there.numbers, mapped[place].numbers, key) for key in SHOWN]
        cells.append("not mapped" if None in found else _percents(found))
    return f"| {' | '.join([*cells, str(sum(there.moved.values())), str(there.strays)])} |"


def _percents(shares: list[float | None]) -> str:
    return ", ".join(f"{100.0 * share:.2f}" for share in shares if share is not None)


def main(out: Path) -> None:
    torch.set_num_threads(1)
    total: Counter[str] = Counter()
    print("| scene | map | Gaussians | from torch | from compiled kernels | moved | strays |")
    print("|---|---|---:|---|---|---:|---:|")
    for scene in scenes(out / "scenes"):
        for variant in VARIANTS:
            mapped = {place: map_scene(scene, variant, place, out) for place in PLACES}
            total += mapped[DEVICE].moved
            print(row_of(scene.name, variant, mapped), flush=True)
    print(", ".join(f"{name} {count}" for name, count in total.most_common()))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
