"""Who is timed here: every renderer that this machine can run, and why the others are not."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import torch

from aquaflow.base.errors import AquaFlowError
from aquaflow.lab.bench.meter import Meter
from aquaflow.lab.bench.render.timing import Clock, Sample, time_renderer, torch_threads
from aquaflow.render.contract import Renderer
from aquaflow.render.cpu import CpuRenderer, TileRenderer
from aquaflow.render.example_scene import SMALL, Size, SplatScene, height_field
from aquaflow.render.gsplat import GsplatRenderer
from aquaflow.render.library import NativeUnavailableError
from aquaflow.render.native.build import supported_isas
from aquaflow.render.reference import ReferenceRenderer
from aquaflow.render.webgpu import WgpuRenderer

TILES_MOST = 30_000 * 640 * 480
REFERENCE_MOST = SMALL.n * SMALL.pixels
"""Gaussians times pixels: beyond, the torch fallback takes minutes and the reference memory."""


@dataclass(frozen=True)
class Timed:
    """A renderer as a contender: draws a scene and its gradients, and reports the times."""

    renderer: Renderer
    most: int | None = None
    """Gaussians times pixels; None: any. What has a limit is slow."""
    clock: Clock | None = None
    meter: Meter | None = None

    @property
    def name(self) -> str:
        """Name of the renderer."""
        return self.renderer.name

    @property
    def isa(self) -> str:
        """Instruction set of the renderer."""
        return self.renderer.isa

    @property
    def threads(self) -> int:
        """Number of threads of the renderer."""
        return self.renderer.threads

    @property
    def slow(self) -> bool:
        """Seconds rather than milliseconds: run once, after the others."""
        return self.most is not None

    def takes(self, size: Size) -> bool:
        """Whether a scene of this size takes a reasonable time."""
        return self.most is None or size.n * size.pixels <= self.most

    def sample(self, scene: SplatScene) -> Sample:
        """One timed run."""
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


def contenders_here(device: str | None = None) -> tuple[list[Timed], list[str]]:
    """The contenders, and one sentence for each that is missing or needs a remark.

    All that run here, or those on ``device``: cpu or cuda.

    Raises:
        AquaFlowError: nothing draws on the device asked for.
    """
    if device == "cuda":
        return contenders_on_gpu(), []
    found: list[Timed] = []
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
        try:
            wgpu = WgpuRenderer()
            found.append(Timed(wgpu, TILES_MOST if wgpu.is_software else None))
        except AquaFlowError as error:
            notes.append(f"wgpu is not timed: {error}")
    found += [Timed(TileRenderer(count), TILES_MOST) for count in thread_counts()]
    found.append(Timed(ReferenceRenderer(), REFERENCE_MOST))
    return found, notes


# --------------------------------------------------------------------------------------------------
# What the blending loops do where nothing is in vain: the limit of their mix of instructions.
#
# The processor's peak counts fused multiply-adds alone. Blending one Gaussian into one pixel also
# takes an exponential, comparisons, masks, loads and stores, and backward a division, which fill
# the same units and count as one operation or none. How much of the peak is left for that mix is
# measured with the loops themselves: on a picture so small that all data is in the first caches,
# with Gaussians that reach every pixel of every tile.

COVERING = Size(100, 64, 64)
"""Sixteen tiles; at an alpha of OPACITY the last Gaussian still finds a transmittance of 0.006."""
OPACITY = 0.05
SIGMA = 50.0
"""Standard deviation, in ranges of the nearest: alpha is the same all over the picture."""
ATTEMPTS = 25
"""The fastest counts; each takes a millisecond."""
FORWARD_STAGE, BACKWARD_STAGE = "blend", "blend backward"


@dataclass(frozen=True)
class BlendLimit:
    """Pairs of a pixel and a Gaussian that one thread blends in a second, at most."""

    fwd: float
    bwd: float

    def seconds(self, interactions: int) -> dict[str, float]:
        """The least that ``interactions`` take one thread, by pass."""
        return {"fwd": interactions / self.fwd, "bwd": interactions / self.bwd}


def covering_scene() -> SplatScene:
    """COVERING, with Gaussians one behind the other that all reach every pixel."""
    scene, n = height_field(COVERING), COVERING.n
    means, scales = torch.zeros(n, 3), torch.full((n, 3), SIGMA)
    means[:, 2], scales[:, 2] = torch.linspace(1.0, 2.0, n), 1e-3
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    colours = scene.inputs[4]
    inputs = (means, quats, scales, torch.full((n,), OPACITY), colours, torch.eye(4))
    return replace(scene, inputs=inputs)


def measure_blend_limit(isa: str) -> BlendLimit:
    """The limit by the kernels of ``isa``, on one thread: the fastest of ATTEMPTS, their clock."""
    renderer, scene = CpuRenderer(1, isa), covering_scene()
    leaves, fastest = scene.leaves(), {FORWARD_STAGE: float("inf"), BACKWARD_STAGE: float("inf")}
    with torch_threads(1):
        for _ in range(ATTEMPTS):
            scene.differentiated_by(renderer, leaves)
            stages = renderer.stage_ms()
            fastest = {name: min(ms, stages[name]) for name, ms in fastest.items()}
    pairs = COVERING.n * COVERING.pixels
    forward, backward = (1e-3 * fastest[name] for name in (FORWARD_STAGE, BACKWARD_STAGE))
    return BlendLimit(pairs / forward, pairs / backward)
