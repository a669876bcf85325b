"""A WebGPU device: the adapter that is taken, compiled kernels, buffers, and reading back."""

from __future__ import annotations

import math
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import AquaFlowError, first_line
from aquaflow.render import adam, contract, photometric, water, wgsl
from aquaflow.render.transfer_counts import COUNTS

MOMENTS = 10
"""Sums of a hit that its gradient follows from; see blend_backward.wgsl."""
CHUNK = 4
"""Gaussians that a workgroup differentiates at once. Their numbers take 10 KB of shared memory, and
WebGPU promises 16 KB."""
LIMITS = ("max-buffer-size", "max-storage-buffer-binding-size")
"""Limits that are asked of an adapter in full: how large a map can be follows from them."""
NODES = ("dri/renderD*", "nvidia*", "nvhost*", "nvmap", "dxg")
"""Below /dev, what drivers of GPUs make on Linux: Mesa's and others', NVIDIA's, a Jetson's, WSL's.
Looking for adapters loads every driver: 70 MB and half a second with Mesa's software adapter."""
BACKENDS = ("Vulkan", "Metal", "DX12")
"""What an adapter is reached through, as wgpu names it. OpenGL is not among them: to look for it
takes longer, and its drivers say on stderr that there is no display."""


@dataclass(frozen=True)
class Adapter:
    """What a report says of an adapter."""

    name: str
    backend: str
    kind: str
    """``DiscreteGPU``, ``IntegratedGPU``, ``CPU`` (software), or as wgpu says."""
    driver: str

    @property
    def is_software(self) -> bool:
        """Whether it is a program that stands in for a GPU, as Mesa's llvmpipe is."""
        return self.kind == "CPU"

    def __str__(self) -> str:
        """All of it in one line."""
        return f"{self.name} ({self.kind}, {self.backend}, {self.driver})"


def missing_package() -> str | None:
    """Why wgpu cannot be used here and what to do, in one sentence; None: it can."""
    try:
        import wgpu  # noqa: F401
    except ImportError:
        return "Renderer wgpu is not installed; run `pip install 'aquaflow[gpu-any]'`."
    except OSError as error:
        return f"The package wgpu does not load ({first_line(error)}); install it again."
    return None


@lru_cache(maxsize=1)
def _wgpu() -> Any:
    """The package, told once which backends it may look for adapters through."""
    if "XDG_RUNTIME_DIR" not in os.environ and "MESA_VK_DEVICE_SELECT" not in os.environ:
        # Mesa's layer that sorts adapters asks a display, and says on stderr that there is none.
        os.environ.setdefault("NODEVICE_SELECT", "1")
    import wgpu
    from wgpu.backends.wgpu_native.extras import set_instance_extras

    set_instance_extras(backends=BACKENDS)
    return wgpu


@lru_cache(maxsize=1)
def find_adapters() -> tuple[tuple[Adapter, Any], ...]:
    """The adapters that kernels can run on, real GPUs first, those with memory of their own before
    the others; each with wgpu's object of it. Looked for once in a process."""
    found = []
    for adapter in _wgpu().gpu.enumerate_adapters_sync():
        info = adapter.info
        names = ("device", "backend_type", "adapter_type", "description")
        found.append((Adapter(*(info[name] for name in names)), adapter))
    order = {"DiscreteGPU": 0, "IntegratedGPU": 1, "CPU": 3}
    return tuple(sorted(found, key=lambda each: order.get(each[0].kind, 2)))


def missing(software: bool = True) -> str | None:
    """Why no adapter can be drawn on, in one sentence; None: one can.

    ``software``: whether a program that stands in for a GPU counts.
    """
    reason = missing_package()
    if reason is not None:
        return reason
    if not (software or _has_gpu()):
        return "There is no GPU: /dev has no device of one."
    found = [adapter for adapter, _ in find_adapters()]
    if not found:
        return (
            "Renderer wgpu finds no adapter; install the GPU's Vulkan driver "
            "(on Debian and Ubuntu mesa-vulkan-drivers, or NVIDIA's), or use renderer cpu."
        )
    if not software and found[0].is_software:
        return f"wgpu finds only {found[0]}, which is slower than renderer cpu."
    return None


def _has_gpu(root: Path = Path("/dev")) -> bool:
    """Whether Linux has a device of a GPU; True on other systems, where only asking tells."""
    return sys.platform != "linux" or any(any(root.glob(node)) for node in NODES)


class Device:
    """The adapter that is taken, and its kernels. One thread at a time: hold ``lock``."""

    def __init__(self) -> None:
        """Raises AquaFlowError, saying what to do, when there is no adapter or it refuses."""
        self.adapter, adapter = find_adapters()[0]
        limits = {name: adapter.limits[name] for name in LIMITS}
        try:
            self.device = adapter.request_device_sync(required_limits=limits)
        except Exception as error:  # drivers say what they like
            raise AquaFlowError(
                f"{self.adapter} refuses to be used ({first_line(error)}); "
                "update its driver, or use renderer cpu."
            ) from error
        self.most_bytes = min(limits.values())
        """Of one buffer."""
        self.lock = threading.Lock()
        self._usage = _wgpu().BufferUsage
        self._modules: dict[str, Any] = {}
        self._pipelines: dict[str, Any] = {}

    def buffer(self, floats: int, uniform: bool = False) -> Any:
        """A buffer of 32-bit numbers, all zero; raises MemoryError where it cannot be had."""
        size = 4 * max(floats, 4)
        if size > self.most_bytes:
            raise MemoryError(
                f"{self.adapter.name} gives buffers of {self.most_bytes / 1e6:.0f} MB at most, "
                f"and one of {size / 1e6:.0f} MB is needed"
            )
        use = self._usage
        kind = use.UNIFORM if uniform else use.STORAGE
        return self.device.create_buffer(size=size, usage=kind | use.COPY_DST | use.COPY_SRC)

    def uniform(
        self,
        numbers: npt.NDArray[Any],  # [...] of 32 bits
    ) -> Any:
        """A uniform buffer with these numbers."""
        buffer = self.buffer(math.ceil(numbers.size / 4) * 4, uniform=True)
        self.write(buffer, numbers)
        return buffer

    def write(
        self,
        buffer: Any,
        numbers: npt.NDArray[Any],  # [...] of 32 bits
    ) -> None:
        """Copy numbers to the beginning of a buffer."""
        if numbers.size:
            COUNTS.add("wgpu bytes up", numbers.nbytes)
            self.device.queue.write_buffer(buffer, 0, np.ascontiguousarray(numbers))

    def kernel(self, file: str, name: str, bindings: Mapping[int, Any]) -> tuple[Any, Any]:
        """The kernel ``name`` of ``file``, with buffers by binding: a pipeline and its bind group.

        Kernels are compiled when they are first asked for.
        """
        if name not in self._pipelines:
            if file not in self._modules:
                code = wgsl.source(file, _constants())
                self._modules[file] = self.device.create_shader_module(code=code, label=file)
            compute = {"module": self._modules[file], "entry_point": name}
            pipeline = self.device.create_compute_pipeline(layout="auto", compute=compute)
            self._pipelines[name] = pipeline
        pipeline = self._pipelines[name]
        entries = [
            {"binding": number, "resource": {"buffer": buffer}}
            for number, buffer in bindings.items()
        ]
        layout = pipeline.get_bind_group_layout(0)
        return pipeline, self.device.create_bind_group(layout=layout, entries=entries)

    def submit(self, plan: Sequence[Step], clear: Sequence[Any] = ()) -> None:
        """Clear buffers, then run the steps one after the other."""
        encoder = self.device.create_command_encoder()
        for buffer in clear:
            encoder.clear_buffer(buffer)
        compute = encoder.begin_compute_pass()
        for step in plan:
            compute.set_pipeline(step.pipeline)
            compute.set_bind_group(0, step.bindings)
            compute.dispatch_workgroups(*step.groups)
        compute.end()
        self.device.queue.submit([encoder.finish()])

    def read(self, parts: Sequence[tuple[Any, int]]) -> list[npt.NDArray[np.float32]]:
        """The first numbers of buffers, each with their count, in one wait for the device."""
        use = self._usage
        total = sum(4 * count for _, count in parts)
        COUNTS.add("wgpu bytes down", total)
        staging = self.device.create_buffer(size=max(total, 4), usage=use.MAP_READ | use.COPY_DST)
        encoder, offset = self.device.create_command_encoder(), 0
        for buffer, count in parts:
            encoder.copy_buffer_to_buffer(buffer, 0, staging, offset, 4 * count)
            offset += 4 * count
        self.device.queue.submit([encoder.finish()])
        staging.map_sync("READ")
        numbers = np.frombuffer(staging.read_mapped(), np.float32)
        staging.unmap()
        staging.destroy()
        ends = np.cumsum([count for _, count in parts])
        return np.split(numbers[: ends[-1]], ends[:-1])


@dataclass(frozen=True)
class Step:
    """A kernel with its buffers, and over how many workgroups it runs."""

    pipeline: Any
    bindings: Any
    groups: tuple[int, ...]


@lru_cache(maxsize=1)
def shared_device() -> Device:
    """The process's device: what is compiled for one renderer is there for the next."""
    return Device()


@cache
def _constants() -> dict[str, float | int]:
    """The constants of the definitions in torch."""
    found: dict[str, float | int] = {
        "SSIM_TAPS": sum(
            math.exp(-(k * k) / (2.0 * photometric.SSIM_SIGMA_PX**2))
            for k in range(-(photometric.SSIM_WINDOW // 2), photometric.SSIM_WINDOW // 2 + 1)
        ),
        "MOMENTS": MOMENTS,
        "CHUNK": CHUNK,
    }
    for module, names in _NAMES.items():
        found |= {name: getattr(module, name) for name in names}
    return found


_NAMES: dict[Any, tuple[str, ...]] = {
    contract: ("COLOUR_SHARPNESS",),
    photometric: (
        *("SSIM_SIGMA_PX", "SSIM_C1", "SSIM_C2", "MIN_RANGE", "SOLID", "RADIAL_VARIANCE"),
    ),
    water: ("MAX_OPTICAL_DEPTH", "MIN_SOLID"),
    adam: ("LARGEST_GRADIENT",),
}
"""Constants of kernels, by the module that defines them."""
