"""Who is timed here: every renderer that this machine can run, and why the others are not."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Protocol

from aquaflow.base.errors import AquaFlowError
from aquaflow.lab.bench.meter import Meter
from aquaflow.lab.bench.render.opensplat import NOTE, OpenSplat
from aquaflow.lab.bench.render.timing import Clock, Sample, time_renderer, torch_threads
from aquaflow.render.contract import Renderer
from aquaflow.render.cpu import CpuRenderer, TileRenderer
from aquaflow.render.example_scene import SMALL, Size, SplatScene
from aquaflow.render.gsplat import GsplatRenderer
from aquaflow.render.library import NativeUnavailableError
from aquaflow.render.native.build import supported_isas
from aquaflow.render.reference import ReferenceRenderer

TILES_MOST = 30_000 * 640 * 480
REFERENCE_MOST = SMALL.n * SMALL.pixels
"""Gaussians times pixels: beyond, the torch fallback takes minutes and the reference memory."""


class BenchmarkedRenderer(Protocol):
    """A renderer that draws a scene and its gradients, and reports the times."""

    @property
    def name(self) -> str:
        """Of the renderer or program, for the table."""
        ...

    @property
    def isa(self) -> str:
        """Instruction set that it runs on, or ``torch``, ``cuda``."""
        ...

    @property
    def threads(self) -> int:
        """Threads that it runs on."""
        ...

    @property
    def slow(self) -> bool:
        """Seconds rather than milliseconds: run once, after the others."""
        ...

    def takes(self, size: Size) -> bool:
        """Whether a scene of this size takes a reasonable time."""
        ...

    def sample(self, scene: SplatScene) -> Sample:
        """One timed run."""
        ...


@dataclass(frozen=True)
class Timed:
    """A renderer of this package as a contender."""

    renderer: Renderer
    most: int | None = None
    """Gaussians times pixels; None: any. What has a limit is slow."""
    clock: Clock | None = None
    meter: Meter | None = None

    @property
    def name(self) -> str:
        """Of the renderer."""
        return self.renderer.name

    @property
    def isa(self) -> str:
        """Of the renderer."""
        return self.renderer.isa

    @property
    def threads(self) -> int:
        """Of the renderer."""
        return self.renderer.threads

    @property
    def slow(self) -> bool:
        return self.most is not None

    def takes(self, size: Size) -> bool:
        return self.most is None or size.n * size.pixels <= self.most

    def sample(self, scene: SplatScene) -> Sample:
        # The kernels have a pool of their own, and idle threads of torch spin on its processors.
        ours = isinstance(self.renderer, CpuRenderer)
        with torch_threads(1 if ours else self.threads):
            return time_renderer(self.renderer, scene, self.clock, self.meter)


def thread_counts() -> tuple[int, ...]:
    """One, and all that this process may use."""
    return tuple(sorted({1, len(os.sched_getaffinity(0))}))


def contenders_on_gpu() -> list[Timed]:
    """Those that draw where gsplat does.

    Raises:
        AquaFlowError: gsplat cannot draw here.
    """
    gsplat = GsplatRenderer()
    return [Timed(gsplat), Timed(ReferenceRenderer(gsplat.device), REFERENCE_MOST)]


def contenders_here(
    opensplat: str | None = None, device: str | None = None
) -> tuple[list[BenchmarkedRenderer], list[str]]:
    """The contenders, and one sentence for each that is missing or needs a remark.

    All that run here, or those on ``device``: cpu or cuda.

    Raises:
        AquaFlowError: nothing draws on the device asked for.
    """
    if device == "cuda":
        return [*contenders_on_gpu()], []
    found: list[BenchmarkedRenderer] = []
    notes: list[str] = []
    for isa in supported_isas():
        try:
            found += [Timed(CpuRenderer(count, isa)) for count in thread_counts()]
        except NativeUnavailableError as error:
            notes.append(str(error))
    if device is None:
        try:
            found.append(Timed(GsplatRenderer()))
        except AquaFlowError as error:
            notes.append(f"gsplat is not timed: {error}")
    found += [Timed(TileRenderer(count), TILES_MOST) for count in thread_counts()]
    found.append(Timed(ReferenceRenderer(), REFERENCE_MOST))
    if opensplat is not None:
        found.append(OpenSplat(opensplat))
        notes.append(NOTE)
    return found, notes
