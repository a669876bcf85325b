"""What one frame costs a prior: matched from a prediction, and matched from nothing.

Wall time is what a vehicle waits; processor time is what other work loses, and does not grow when
other programs use the machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.contract import Prior

Picture = npt.NDArray[np.uint8]

MOVED_WIDTHS = 0.01
"""Shift of a frame that a prediction was made for: a vehicle's motion in a tenth of a second."""
FAR_WIDTHS = 0.25
"""Shift of a frame that nothing is known about: beyond what flow alone follows."""
LEAST_RUNS = 3
"""Timed runs of each contender, however slow it is."""


@dataclass(frozen=True)
class BenchmarkedPrior:
    """A prior as it is set up."""

    name: str
    variant: str
    """Precision of the network's weights; ``none`` without a network."""
    threads: int
    prior: Prior


@dataclass(frozen=True)
class Spent:
    """Medians of one kind of work, in milliseconds."""

    ms: float
    cpu_ms: float


def latency_rows(
    contenders: Sequence[BenchmarkedPrior],
    sizes: Sequence[tuple[int, int]],  # width, height
    repeats: int,
    progress: Callable[[str, int, int], None],
) -> list[dict[str, Any]]:
    """One row for each contender, size and kind of work, the contenders in turn."""
    rows = []
    jobs = [(contender, size) for size in sizes for contender in contenders]
    for done, (contender, (width, height)) in enumerate(jobs):
        progress("latency", done, len(jobs))
        for work, spent in _measure_latency(contender.prior, width, height, repeats).items():
            rows.append(
                {
                    "prior": contender.name,
                    "variant": contender.variant,
                    "threads": contender.threads,
                    "width": width,
                    "height": height,
                    "work": work,
                    "ms": round(spent.ms, 2),
                    "cpu_ms": round(spent.cpu_ms, 2),
                }
            )
    progress("latency", len(jobs), len(jobs))
    return rows


def _measure_latency(prior: Prior, width: int, height: int, repeats: int) -> dict[str, Spent]:
    """``tracked``: a frame near its prediction; ``found``: one that moved far, none expected."""
    camera = CameraModel(width, height, float(width), float(width), width / 2, height / 2)
    floor = sea_floor(width, height)
    reference = prior.encode(_view(floor, width, height, 0.0), camera)
    near = _view(floor, width, height, MOVED_WIDTHS)
    far = _view(floor, width, height, FAR_WIDTHS)
    expected = prior.decode(reference, prior.encode(near, camera)).matches
    prior.decode(reference, prior.encode(far, camera))  # what is kept of the reference is there
    return {
        "tracked": measure_time(
            lambda: prior.decode(reference, prior.encode(near, camera), expected), repeats
        ),
        "found": measure_time(lambda: prior.decode(reference, prior.encode(far, camera)), repeats),
    }


def measure_time(work: Callable[[], object], repeats: int) -> Spent:
    """Medians over ``repeats`` calls."""
    wall, cpu = [], []
    for _ in range(max(repeats, LEAST_RUNS)):
        began, cpu_began = time.perf_counter(), time.process_time()
        work()
        wall.append(time.perf_counter() - began)
        cpu.append(time.process_time() - cpu_began)
    return Spent(1e3 * float(np.median(wall)), 1e3 * float(np.median(cpu)))


def sea_floor(width: int, height: int) -> Picture:
    """[height, 2 width, 3] texture of several scales."""
    rng = np.random.default_rng(0)
    total = np.zeros((height, 2 * width, 3), np.float32)
    for sigma in (1.0, 3.0, 9.0):
        layer = cv2.GaussianBlur(
            rng.normal(size=total.shape).astype(np.float32), (0, 0), sigma * width / 320.0
        )
        total += layer / layer.std()
    return np.asarray(np.clip(127.0 + 28.0 * total, 0, 255), dtype=np.uint8)


def _view(
    floor: Picture,  # [H, W, 3] RGB
    width: int,
    height: int,
    moved: float,
) -> Picture:
    left = round(moved * width)
    return np.ascontiguousarray(floor[:height, left : left + width])
