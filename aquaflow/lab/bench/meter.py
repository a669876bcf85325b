"""The time and the memory that work on a device takes, as the device itself counts them."""

from __future__ import annotations

from typing import Any, Protocol

import torch

from aquaflow.base.errors import AquaFlowError
from aquaflow.render import gsplat
from aquaflow.render.gsplat import gpu_here

DEVICES = ("cpu", "cuda")
"""Where maps can be drawn and optimised while a benchmark looks."""


class Meter(Protocol):
    """Waits for a device, and asks it what its work took."""

    def settle(self) -> None:
        """Wait until the device has done what it was given."""
        ...

    def mark(self) -> Any:
        """A point in the device's work, after what it was given so far."""
        ...

    def between_ms(self, first: Any, second: Any) -> float | None:
        """The device's own time between two marks that it has passed; None: it has no clock."""
        ...

    def forget_peak(self) -> None:
        """Begin a new peak of memory."""
        ...

    def peak_mb(self) -> float | None:
        """Most memory that torch held on the device since; None: it has none of its own."""
        ...


class OnCpu:
    """The processor: it has done what a call returns from, and the process's memory is its own."""

    def settle(self) -> None:
        """Nothing is under way."""

    def mark(self) -> None:
        """There is no clock but the wall's and the thread's."""

    def between_ms(self, first: object, second: object) -> None:
        """No clock of its own."""

    def forget_peak(self) -> None:
        """Nothing is counted."""

    def peak_mb(self) -> None:
        """No memory of its own."""


class OnCuda:
    """A CUDA device: events in its stream of work, and torch's count of what it allocated there."""

    def settle(self) -> None:
        """Wait for all streams."""
        torch.cuda.synchronize()

    def mark(self) -> torch.cuda.Event:
        """An event in the current stream."""
        event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
        event.record()
        return event

    def between_ms(self, first: torch.cuda.Event, second: torch.cuda.Event) -> float:
        """Between two events, idle time of the device included."""
        return float(first.elapsed_time(second))

    def forget_peak(self) -> None:
        """What is allocated now stays counted."""
        torch.cuda.reset_peak_memory_stats()

    def peak_mb(self) -> float:
        """1e6 bytes; neither the driver's own memory nor onnxruntime's."""
        return round(torch.cuda.max_memory_allocated() / 1e6, 1)


def meter_of(device: torch.device) -> Meter:
    """The meter that fits ``device``."""
    return OnCuda() if device.type == "cuda" else OnCpu()


def require(device: str | None) -> None:
    """Nothing, if maps can be drawn on ``device`` here; None: wherever they are.

    Raises:
        AquaFlowError: there is no GPU, or no gsplat that draws on it.
    """
    if device != "cuda":
        return
    gpu = gpu_here()
    if isinstance(gpu, str):
        raise AquaFlowError(f"--device cuda: {gpu}; use --device cpu")
    if (reason := gsplat.missing()) is not None:
        raise AquaFlowError(f"--device cuda: {reason}")
