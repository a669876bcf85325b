"""The machine as the doctor sees it, below a root that tests replace; what its GPU is used for."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import platform
import re
import shutil
import struct
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from aquaflow.doctor.attempts import SOFTWARE, Attempt, Figures, apart

if TYPE_CHECKING:
    from aquaflow.render.gsplat import Gpu


@dataclass(frozen=True)
class CheckResult:
    """The result of one check."""

    name: str
    found: str
    used_for: str
    """What AquaFlow will therefore do."""
    advice: str = ""
    """What to do if it is wanted; empty if nothing is missing."""
    figures: Figures = field(default_factory=dict)
    """What was measured, for programs."""

    @property
    def ok(self) -> bool:
        """True if nothing is to be done."""
        return not self.advice


def _torch_gpu() -> Gpu | str:
    """The GPU that torch sees, or why it sees none; there may be no torch, as on 32 bits."""
    try:
        from aquaflow.render.gsplat import gpu_here
    except ImportError:
        return "torch is not installed"
    return gpu_here()


def _onnx_providers() -> list[str]:
    """onnxruntime's own names of the processors that it was built for; none without it."""
    try:
        import onnxruntime
    except ImportError:
        return []
    return list(onnxruntime.get_available_providers())


def _module_present(name: str) -> bool:
    return importlib.util.find_spec(name) is not None


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


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
    gpu: Callable[[], Gpu | str] = _torch_gpu
    """The GPU, or half a sentence on why there is none."""
    onnx_providers: Callable[[], list[str]] = _onnx_providers
    attempt: Callable[[str], Attempt] = apart
    """Tries something on the GPU (see ``attempts``)."""
    module_present: Callable[[str], bool] = _module_present
    version: Callable[[str], str | None] = _version
    """Of an installed distribution."""
    renderer: Callable[[], str | None] = renderer_name

    def text(self, path: str) -> str:
        """Content of a file below the root, stripped; empty if it cannot be read."""
        try:
            return (self.root / path).read_text(errors="replace").strip("\0\n ")
        except OSError:
            return ""

    def driver(self) -> str:
        """Version of NVIDIA's driver, as in 580.159.03; empty without one."""
        found = re.search(r"\d{3,}\.\d+(\.\d+)?", self.text("proc/driver/nvidia/version"))
        return "" if found is None else found[0]

    def paths(self, *patterns: str) -> list[Path]:
        """Paths below the root that match, sorted within each pattern."""
        return [path for pattern in patterns for path in sorted(self.root.glob(pattern))]


# --------------------------------------------------------------------------------------------------
# What a GPU is used for: what was tried on it and came out right, not what is installed.

CUDA, TENSORRT = "CUDAExecutionProvider", "TensorrtExecutionProvider"
"""onnxruntime's names."""


def findings(machine: MachineProbes) -> list[CheckResult]:
    """The GPU, and what ran on it; only that there is none, where there is none.

    Where onnxruntime says that it can use a GPU, it is tried even if torch sees none.
    """
    gpu = machine.gpu()
    providers = machine.onnx_providers()
    any_gpu = [_webgpu(machine)] if machine.module_present("wgpu") else []
    if isinstance(gpu, str):
        cuda = [_cuda(machine)] if CUDA in providers else []
        return [_absent(machine, gpu, bool(any_gpu)), *any_gpu, *cuda]
    driver = machine.driver()
    found = f"{gpu}{f', driver {driver}' if driver else ''}"
    return [
        CheckResult(
            "GPU", found, "tracking runs on the processor; the map and learned priors: below"
        ),
        _gsplat(machine),
        *any_gpu,
        _cuda(machine),
        *([_tensorrt(machine)] if TENSORRT in providers else []),
    ]


def _absent(machine: MachineProbes, reason: str, others: bool) -> CheckResult:
    """torch reaches no GPU; ``others`` are for wgpu to find."""
    if not (machine.which("nvidia-smi") or machine.driver()):
        if others:
            return CheckResult("GPU", "none with CUDA", "learned priors run on the processor")
        return CheckResult("GPU", "none", "everything runs on the processor")
    return CheckResult(
        "GPU",
        "an NVIDIA driver, but torch cannot use the GPU",
        "maps are drawn on the processor",
        f"{reason}; install a build of torch that fits the driver",
    )


def _gsplat(machine: MachineProbes) -> CheckResult:
    tried = machine.attempt("gsplat")
    if tried.failed:
        return CheckResult(
            "gsplat", "does not draw", "maps are drawn on the processor", tried.failed
        )
    found = _drew(tried.figures)
    return CheckResult("gsplat", found, "maps are optimised on the GPU", figures=tried.figures)


def _webgpu(machine: MachineProbes) -> CheckResult:
    """Every maker's GPU; a program that stands in for one is no shortcoming, and not used."""
    tried = machine.attempt("wgpu")
    if tried.failed:
        return CheckResult(
            "WebGPU", "does not draw", "maps are drawn on the processor", tried.failed
        )
    taken, *others = tried.adapters
    found = f"{taken} {_drew(tried.figures)}{''.join(f'; also {each}' for each in others)}"
    if tried.figures.get(SOFTWARE):
        used = "maps are drawn on the processor: this is a program, and slower"
    else:
        used = "maps are drawn on it where that is the fastest"
    return CheckResult("WebGPU", found, used, figures=tried.figures)


def _drew(figures: Figures) -> str:
    return (
        f"drew a known scene and its gradients, {_times(figures)}; the picture is "
        f"{figures['difference_picture']:.1e} of full scale from the reference's, the "
        f"gradients {figures['difference_gradients']:.1e}"
    )


def _cuda(machine: MachineProbes) -> CheckResult:
    tried = machine.attempt("cuda")
    name = "ONNX Runtime, CUDA"
    if tried.failed:
        return CheckResult(
            name, "does not run", "learned priors run on the processor", tried.failed
        )
    return CheckResult(
        name, _ran(tried.figures), "learned priors run on the GPU", "", tried.figures
    )


def _tensorrt(machine: MachineProbes) -> CheckResult:
    """TensorRT is no more than faster: without it, nothing is to be done."""
    tried = machine.attempt("tensorrt")
    name = "ONNX Runtime, TensorRT"
    if tried.failed:
        return CheckResult(name, f"does not run: {tried.failed}", "CUDA is used in its place")
    return CheckResult(name, _ran(tried.figures), "learned priors run on it", "", tried.figures)


def _ran(figures: Figures) -> str:
    return (
        f"ran the compact prior, {_times(figures)}; {figures['difference']:.1e} from what the "
        "processor says"
    )


def _times(figures: Figures) -> str:
    return f"{figures['first_call_s']:.1f} s the first time, then {figures['next_call_ms']:.1f} ms"
