"""What a GPU is used for: what was tried on it and came out right, not what is installed."""

from __future__ import annotations

from aquaflow.doctor.attempts import Figures
from aquaflow.doctor.machine import CheckResult, MachineProbes

CUDA, TENSORRT = "CUDAExecutionProvider", "TensorrtExecutionProvider"
"""onnxruntime's names."""


def findings(machine: MachineProbes) -> list[CheckResult]:
    """The GPU, and what ran on it; only that there is none, where there is none.

    Where onnxruntime says that it can use a GPU, it is tried even if torch sees none.
    """
    gpu = machine.gpu()
    providers = machine.onnx_providers()
    if isinstance(gpu, str):
        return [_absent(machine, gpu), *([_cuda(machine)] if CUDA in providers else [])]
    driver = machine.driver()
    found = f"{gpu}{f', driver {driver}' if driver else ''}"
    return [
        CheckResult(
            "GPU", found, "tracking runs on the processor; the map and learned priors: below"
        ),
        _gsplat(machine),
        _cuda(machine),
        *([_tensorrt(machine)] if TENSORRT in providers else []),
    ]


def _absent(machine: MachineProbes, reason: str) -> CheckResult:
    if not (machine.which("nvidia-smi") or machine.driver()):
        return CheckResult("GPU", "none", "everything runs on the processor")
    return CheckResult(
        "GPU",
        "an NVIDIA driver, but torch cannot use the GPU",
        "maps are drawn on the processor",
        f"{reason}; install a build of torch that fits the driver (docs/gpu.md)",
    )


def _gsplat(machine: MachineProbes) -> CheckResult:
    tried = machine.attempt("gsplat")
    if tried.failed:
        return CheckResult(
            "gsplat", "does not draw", "maps are drawn on the processor", tried.failed
        )
    found = (
        f"drew a known scene and its gradients, {_times(tried.figures)}; the picture is "
        f"{tried.figures['difference_picture']:.1e} of full scale from the reference's, the "
        f"gradients {tried.figures['difference_gradients']:.1e}"
    )
    return CheckResult("gsplat", found, "maps are optimised on the GPU", figures=tried.figures)


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
