"""One timed forward and backward pass, and how repeats of many contenders are interleaved."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from statistics import median
from typing import Protocol, TypeVar, runtime_checkable

import torch

from aquaflow.lab.bench.meter import Meter, meter_of
from aquaflow.lab.bench.summary import Spread
from aquaflow.render.contract import Renderer
from aquaflow.render.example_scene import SplatScene

T = TypeVar("T")


@dataclass(frozen=True)
class Clock:
    """Seconds since some moment: on the wall, and of this thread on a processor."""

    wall: Callable[[], float] = time.perf_counter
    cpu: Callable[[], float] = time.thread_time


@dataclass(frozen=True)
class Sample:
    """One run, in milliseconds."""

    fwd_ms: float
    bwd_ms: float
    fwd_cpu_ms: float | None = None
    """None: more than one thread took part, or it was not counted."""
    bwd_cpu_ms: float | None = None
    stage_ms: Mapping[str, float] = field(default_factory=dict)
    fwd_gpu_ms: float | None = None
    """By the GPU's own clock; None: it was not drawn on one."""
    bwd_gpu_ms: float | None = None
    gpu_mb: float | None = None
    """Most memory that torch held on the GPU."""


@runtime_checkable
class ReportsStages(Protocol):
    """A renderer that knows where its last forward and backward pass spent their time."""

    def stage_ms(self) -> Mapping[str, float]:
        """Milliseconds of each stage, in order."""
        ...


def time_renderer(
    renderer: Renderer, scene: SplatScene, clock: Clock | None = None, meter: Meter | None = None
) -> Sample:
    """Draw, then the gradients of all inputs for a given gradient of image and alpha."""
    clock, device = clock or Clock(), renderer.device
    meter = meter or meter_of(device)
    leaves = scene.leaves(device)
    dtype = torch.float64 if renderer.name == "reference" else torch.float32
    incoming = [g.to(device=device, dtype=dtype) for g in (scene.g_image, scene.g_alpha)]
    meter.forget_peak()
    meter.settle()
    marks, begin = [meter.mark()], (clock.wall(), clock.cpu())
    drawn = scene.drawn_by(renderer, leaves)
    marks.append(meter.mark())
    meter.settle()
    middle = clock.wall(), clock.cpu()
    marks.append(meter.mark())
    torch.autograd.grad([drawn.image, drawn.alpha], leaves, incoming)
    marks.append(meter.mark())
    meter.settle()
    end = clock.wall(), clock.cpu()
    fwd, bwd = (
        [1e3 * (after - before) for before, after in zip(first, second, strict=True)]
        for first, second in ((begin, middle), (middle, end))
    )
    alone = renderer.threads == 1 and device.type == "cpu"
    fwd_cpu, bwd_cpu = (fwd[1], bwd[1]) if alone else (None, None)
    stages = dict(renderer.stage_ms()) if isinstance(renderer, ReportsStages) else {}
    gpu = meter.between_ms(*marks[:2]), meter.between_ms(*marks[2:])
    return Sample(fwd[0], bwd[0], fwd_cpu, bwd_cpu, stages, *gpu, meter.peak_mb())


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """So many threads for torch's own kernels."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def interleave(jobs: Sequence[Callable[[], T]], repeats: int) -> list[list[T]]:
    """Results of each job, in the order of ``jobs``.

    Repeats are the outer loop and each starts with another job, so that a machine that slows down
    meanwhile does so for all.
    """
    results: list[list[T]] = [[] for _ in jobs]
    for repeat in range(repeats):
        for position in range(len(jobs)):
            turn = (position + repeat) % len(jobs)
            results[turn].append(jobs[turn]())
    return results


def spread_of(values: Sequence[float]) -> Spread:
    """Median, and half the distance from the lowest to the highest."""
    return Spread(median(values), (max(values) - min(values)) / 2.0, len(values))
