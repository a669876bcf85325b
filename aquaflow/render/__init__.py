"""One differentiable Gaussian renderer behind three implementations.

``select_renderer`` picks: ``cpu`` (compiled SIMD kernels), ``tiles`` (torch), ``gsplat`` (CUDA).
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Literal

from aquaflow.base.worker import core_count

if TYPE_CHECKING:
    from aquaflow.render.contract import Renderer

RendererName = Literal["auto", "cpu", "tiles", "gsplat"]


def select_renderer(name: RendererName = "auto", threads: int | None = None) -> Renderer:
    """The renderer called ``name``; ``auto`` takes gsplat on CUDA machines, else the CPU kernels.

    ``threads`` defaults to torch's number; more than the machine has cores are not used. Where
    ``auto`` finds no compiled library and no compiler it warns once, in one sentence, and returns
    the torch tile renderer. Raises AquaFlowError when a renderer asked for by name is not to be
    had.
    """
    threads = None if threads is None else min(threads, core_count())
    from aquaflow.render import gsplat
    from aquaflow.render.cpu import TileRenderer

    if name == "gsplat" or (name == "auto" and gsplat.available()):
        return gsplat.GsplatRenderer()
    if name == "tiles":
        return TileRenderer(threads)
    return cpu_renderer(threads, may_fall_back=name == "auto")


def cpu_renderer(threads: int | None = None, may_fall_back: bool = True) -> Renderer:
    """The CPU's renderer: compiled kernels, else, if it ``may_fall_back``, torch's tiles."""
    from aquaflow.render.cpu import CpuRenderer, TileRenderer
    from aquaflow.render.library import NativeUnavailableError

    try:
        return CpuRenderer(threads)
    except NativeUnavailableError as error:
        if not may_fall_back:
            raise
        warnings.warn(
            f"{error} Drawing with the torch tile renderer instead, hundreds of times slower.",
            RuntimeWarning,
            stacklevel=3,
        )
        return TileRenderer(threads)


__all__ = ["RendererName", "cpu_renderer", "select_renderer"]
