"""The GPU that torch sees, by its name, or why torch sees none."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch

from aquaflow.base.errors import first_line


@dataclass(frozen=True)
class Gpu:
    """What a report says of a GPU, and of the torch that reaches it."""

    name: str
    capability: str
    """Compute capability, as in 8.7."""
    memory_gb: float
    torch: str
    cuda: str
    """Versions of torch, and of the CUDA that it was built with."""
    kernels: tuple[str, ...]
    """What torch's own kernels were compiled for, as in sm_87."""

    def __str__(self) -> str:
        """All of it in one line."""
        return (
            f"{self.name}, compute capability {self.capability}, {self.memory_gb:.1f} GB, "
            f"torch {self.torch} with CUDA {self.cuda}"
        )


def gpu_here() -> Gpu | str:
    """The first GPU, or half a sentence on why torch sees none."""
    if torch.version.cuda is None:
        return f"torch {torch.__version__} is a build for the processor"
    with warnings.catch_warnings(record=True) as said:  # torch warns of a driver that is too old
        warnings.simplefilter("always")
        available = torch.cuda.is_available()
    if not available:
        cause = f" ({first_line(said[-1].message)})" if said else ""  # type: ignore[arg-type]
        return f"torch {torch.__version__} with CUDA {torch.version.cuda} sees no GPU{cause}"
    properties = torch.cuda.get_device_properties(0)
    return Gpu(
        properties.name,
        f"{properties.major}.{properties.minor}",
        properties.total_memory / 1e9,
        torch.__version__,
        torch.version.cuda,
        tuple(torch.cuda.get_arch_list()),
    )
