"""The machine as the doctor sees it: files below a root that tests replace; nothing is opened."""

from __future__ import annotations

import importlib.util
import platform
import shutil
import struct
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    name: str
    found: str
    used_for: str
    """What AquaFlow will therefore do."""
    advice: str = ""
    """What to do if it is wanted; empty if nothing is missing."""

    @property
    def ok(self) -> bool:
        """True if nothing is to be done."""
        return not self.advice


def _torch_gpu() -> str | None:
    """Name and memory of the GPU that torch can use; None without torch, as on a 32-bit system."""
    try:
        import torch
    except ImportError:
        return None
    if not torch.cuda.is_available():
        return None
    properties = torch.cuda.get_device_properties(0)
    return f"{properties.name}, {properties.total_memory / 1e9:.0f} GB"


def _module_present(name: str) -> bool:
    return importlib.util.find_spec(name) is not None


def renderer_name() -> str | None:
    """What renders here without being asked for, and on which instruction set; None if nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a fallback is reported in the findings
        try:
            from aquaflow.render import select_renderer

            chosen = select_renderer()
            return f"{chosen.name}, {chosen.isa}"
        except ImportError:
            return None


def _architecture() -> tuple[str, int]:
    return platform.machine(), 8 * struct.calcsize("P")


def _native_folder() -> Path:
    return Path(__file__).parents[1] / "render" / "native"


@dataclass(frozen=True)
class MachineProbes:
    """How the doctor examines the machine; a test can replace each probe."""

    root: Path = Path("/")
    disk: Path = field(default_factory=Path.cwd)
    """Folder whose file system dives are written to."""
    native: Path = field(default_factory=_native_folder)
    """Folder of the compiled rasterisers."""
    architecture: tuple[str, int] = field(default_factory=_architecture)
    """The system's name for the processor, and the bits of the interpreter's pointers."""
    which: Callable[[str], str | None] = shutil.which
    gpu: Callable[[], str | None] = _torch_gpu
    module_present: Callable[[str], bool] = _module_present
    renderer: Callable[[], str | None] = renderer_name

    def text(self, path: str) -> str:
        """Content of a file below the root, stripped; empty if it cannot be read."""
        try:
            return (self.root / path).read_text(errors="replace").strip("\0\n ")
        except OSError:
            return ""

    def paths(self, *patterns: str) -> list[Path]:
        """Paths below the root that match, sorted within each pattern."""
        return [path for pattern in patterns for path in sorted(self.root.glob(pattern))]
