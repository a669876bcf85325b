"""One differentiable Gaussian renderer behind four implementations.

``select_renderer`` picks: ``cpu`` (compiled SIMD kernels), ``tiles`` (torch), ``gsplat`` (CUDA),
``wgpu`` (every maker's GPU).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Literal

from aquaflow.base.worker import core_count

if TYPE_CHECKING:
    from aquaflow.render.contract import Renderer

RendererName = Literal["auto", "cpu", "tiles", "gsplat", "wgpu"]


def select_renderer(name: RendererName = "auto", threads: int | None = None) -> Renderer:
    """The renderer called ``name``; ``auto`` takes the fastest of those that draw here.

    ``threads`` defaults to torch's number; more than the machine has cores are not used. ``auto``
    measures where there is a choice, once in a process; software adapters of ``wgpu`` are only for
    those who ask by name. Where it finds no GPU, no compiled library and no compiler it warns once,
    in one sentence, and returns the torch tile renderer. Raises AquaFlowError when a renderer asked
    for by name is not to be had.
    """
    threads = None if threads is None else min(threads, core_count())
    from aquaflow.render.cpu import TileRenderer, cpu_renderer
    from aquaflow.render.gsplat import GsplatRenderer

    if name == "gsplat":
        return GsplatRenderer()
    if name == "wgpu":
        from aquaflow.render.webgpu import WgpuRenderer

        return WgpuRenderer(threads)
    if name == "tiles":
        return TileRenderer(threads)
    if name == "auto" and _gpu_renderers(threads):
        return _measured(threads)
    return cpu_renderer(threads, may_fall_back=name == "auto")


def _gpu_renderers(threads: int | None) -> list[Callable[[], Renderer]]:
    """Makers of those that can draw on a real GPU here."""
    from aquaflow.render import gsplat
    from aquaflow.render.webgpu import WgpuRenderer
    from aquaflow.render.webgpu_device import missing

    found: list[Callable[[], Renderer]] = []
    if gsplat.available():
        found.append(gsplat.GsplatRenderer)
    if missing(software=False) is None:
        found.append(partial(WgpuRenderer, threads))
    return found


@lru_cache(maxsize=4)
def _measured(threads: int | None) -> Renderer:
    from aquaflow.render.choice import fastest
    from aquaflow.render.cpu import cpu_renderer

    return fastest([*_gpu_renderers(threads), partial(cpu_renderer, threads)])


__all__ = ["RendererName", "select_renderer"]
