"""The attempts themselves, on devices that are pretended and on this machine, which has no GPU."""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import replace
from importlib import metadata
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from aquaflow.base.errors import AquaFlowError
from aquaflow.doctor import attempts
from aquaflow.doctor.attempts import Attempt, apart, draw, infer
from aquaflow.prior import runtime
from aquaflow.prior.runtime import PROVIDERS
from aquaflow.render import example_scene
from aquaflow.render import gsplat as gpu
from aquaflow.render.contract import CPU, Rendering
from aquaflow.render.example_scene import Size
from aquaflow.render.gsplat import Gpu, gpu_here
from aquaflow.render.reference import ReferenceRenderer
from tests.device.device_scenes import SinglePrecision
from tests.pretended_device import PRETENDED, pretended_device
from tests.prior.pretended_gpu import PretendedGpu
from tests.render.render_scenes import needs_adapter

ORIN = Gpu("Orin", "8.7", 7.4, "2.8.0", "12.6", ("sm_80", "sm_90"))
NO_IMAGE = "CUDA error: no kernel image is available for execution on the device\nlong advice"


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene that takes no time."""
    monkeypatch.setattr(example_scene, "SMALL", Size(60, 40, 30))


def refusal(try_it: Any, *arguments: Any) -> str:
    """The one sentence that an attempt fails with."""
    with pytest.raises(AquaFlowError) as refused:
        try_it(*arguments)
    assert "\n" not in str(refused.value)
    return str(refused.value)


# --- drawing ------------------------------------------------------------------------------------


class Faulty:
    """A renderer that does something to its picture, or fails."""

    name, isa, threads, device = "faulty", "torch", 1, CPU

    def __init__(self, fault: Any) -> None:
        self.fault = fault

    def __call__(self, *inputs: Any) -> Rendering:
        drawn = ReferenceRenderer()(*inputs)
        return replace(drawn, image=self.fault(drawn.image))


def failing(message: str) -> Any:
    def fail(*_: Any, **__: Any) -> Any:
        raise RuntimeError(message)

    return fail


def test_a_scene_is_drawn_on_the_device_and_compared_on_the_cpu() -> None:
    with pretended_device() as device:
        figures = draw(lambda: SinglePrecision(PRETENDED))
        assert device.moved_in > 0
    assert 0.0 < figures["difference_gradients"] < 1e-6
    assert 0.0 < figures["difference_picture"] < 1e-6
    assert figures["first_call_s"] > 0.0
    assert figures["next_call_ms"] > 0.0


def test_a_renderer_that_draws_wrongly_is_not_to_be_used() -> None:
    said = refusal(draw, lambda: Faulty(lambda image: 1.05 * image))
    assert said.startswith("faulty draws wrongly here: its picture is ")
    assert said.endswith("set mapping.renderer: cpu")


def test_kernels_for_another_compute_capability_say_how_to_compile_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gpu, "gpu_here", lambda: ORIN)
    said = refusal(draw, lambda: Faulty(failing(NO_IMAGE)))
    assert "gsplat's kernels were not compiled for compute capability 8.7" in said
    assert "TORCH_CUDA_ARCH_LIST=8.7" in said


def test_a_torch_without_kernels_for_the_gpu_is_found_out_before_gsplat(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gpu, "gpu_here", lambda: ORIN)
    monkeypatch.setattr(torch, "zeros", failing(NO_IMAGE))
    said = refusal(draw, lambda: Faulty(failing("never reached")))
    assert said.startswith("torch 2.8.0 has kernels for sm_80, sm_90 and not for compute")


def test_any_other_failure_gives_torchs_first_line() -> None:
    said = refusal(draw, lambda: Faulty(failing("CUDA out of memory. Tried 2 MiB\nmore")))
    assert said == "gsplat fails on this GPU (CUDA out of memory. Tried 2 MiB)"


@pytest.mark.parametrize(
    ("version", "kernels", "said"),
    [
        (None, object(), "gsplat is not installed"),
        ("1.4.0", object(), "gsplat 1.4.0 is too old"),
        ("1.5.3", None, "install the CUDA toolkit (nvcc)"),
    ],
)
def test_a_gsplat_that_is_absent_old_or_without_kernels_is_named(
    monkeypatch: pytest.MonkeyPatch, version: str | None, kernels: object, said: str
) -> None:
    def installed(name: str) -> str:
        if version is None:
            raise metadata.PackageNotFoundError(name)
        return version

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(metadata, "version", installed)
    backend = ModuleType("gsplat.cuda._backend")
    backend.__dict__["_C"] = kernels
    for module in (ModuleType("gsplat"), ModuleType("gsplat.cuda"), backend):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    assert said in refusal(draw)


def test_without_a_gpu_gsplat_is_refused_as_anywhere_else() -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    assert "torch sees none" in refusal(draw)


# --- networks -----------------------------------------------------------------------------------


def as_it_is(name: str, value: np.ndarray) -> np.ndarray:
    return value


def wrong(name: str, value: np.ndarray) -> np.ndarray:
    return 1.2 * value


@pytest.mark.parametrize("device", ["cuda", "tensorrt"])
def test_the_shipped_prior_runs_on_the_provider(
    monkeypatch: pytest.MonkeyPatch, device: Any
) -> None:
    monkeypatch.setattr(runtime, "_onnxruntime", lambda: PretendedGpu(device, as_it_is))
    figures = infer(device)
    assert figures["difference"] == 0.0
    assert figures["first_call_s"] > 0.0
    assert figures["next_call_ms"] > 0.0


def test_a_provider_that_says_something_else_is_not_to_be_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(runtime, "_onnxruntime", lambda: PretendedGpu("cuda", wrong))
    assert "on cuda in fp32 differs from the CPU by" in refusal(infer, "cuda")


def test_a_provider_that_is_offered_and_silently_not_used_is_found_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ort = runtime._onnxruntime()
    offering = SimpleNamespace(
        get_available_providers=lambda: [PROVIDERS["cuda"], PROVIDERS["cpu"]],
        SessionOptions=ort.SessionOptions,
        # As the real one does where its CUDA libraries are missing: a session, on the CPU.
        InferenceSession=lambda path, options, providers: ort.InferenceSession(
            path, options, providers=[PROVIDERS["cpu"]]
        ),
        __file__=ort.__file__,
    )
    monkeypatch.setattr(runtime, "_onnxruntime", lambda: offering)
    said = refusal(infer, "cuda")
    assert "was to run on cuda but onnxruntime fell back to CPUExecutionProvider" in said
    assert "libonnxruntime_providers_cuda.so" in said


def test_an_onnxruntime_without_the_provider_is_named() -> None:
    if PROVIDERS["cuda"] in runtime._onnxruntime().get_available_providers():
        pytest.skip("this onnxruntime is built for CUDA")
    assert "has no CUDAExecutionProvider; install onnxruntime-gpu" in refusal(infer, "cuda")


# --- apart --------------------------------------------------------------------------------------


def python(program: str) -> tuple[str, ...]:
    return (sys.executable, "-c", program)


def test_what_an_attempt_measured_is_the_last_line_that_it_prints() -> None:
    command = python("print('noise'); print('{\"figures\": {\"first_call_s\": 1.5}}')")
    assert apart("gsplat", command) == Attempt({"first_call_s": 1.5})


@pytest.mark.parametrize(
    ("program", "said"),
    [
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            "it crashed (SIGSEGV): it said nothing",
        ),
        ("import sys; sys.exit('no such library')", "it crashed (status 1): no such library"),
        ("import time; time.sleep(600)", "it did not end within 0 minutes"),
    ],
)
def test_an_attempt_that_crashes_or_hangs_is_a_sentence(program: str, said: str) -> None:
    limit_s = 0.2 if "sleep" in program else 300.0
    assert apart("gsplat", python(program), limit_s).failed == said


def test_an_attempt_on_this_machine_comes_back_from_its_process() -> None:
    if PROVIDERS["cuda"] in runtime._onnxruntime().get_available_providers():
        pytest.skip("this onnxruntime is built for CUDA")
    assert "install onnxruntime-gpu" in apart("cuda").failed


@needs_adapter
def test_an_adapter_draws_as_the_reference_does_and_is_named() -> None:
    tried = apart("wgpu")
    assert not tried.failed
    assert tried.adapters
    assert tried.figures["difference_picture"] < 1e-4
    assert tried.figures["difference_gradients"] < 1e-3


def test_an_adapter_that_fails_while_it_draws_is_not_to_be_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Failing(ReferenceRenderer):
        failed = "Some GPU failed (device lost)"

    monkeypatch.setattr("aquaflow.render.webgpu.WgpuRenderer", Failing)
    said = refusal(attempts.draw_on_adapter)
    assert said == (
        "Some GPU failed (device lost); update its driver, or set mapping.renderer: cpu"
    )


def test_what_libraries_print_meanwhile_is_not_the_answer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def loud() -> dict[str, float]:
        print("*** EP Error ***")
        return {"difference": 0.5}

    monkeypatch.setitem(attempts.ATTEMPTS, "cuda", loud)
    monkeypatch.setattr(sys, "argv", ["attempts", "cuda"])
    attempts.main()
    printed = json.loads(capsys.readouterr().out)
    assert printed == {"figures": {"difference": 0.5}, "failed": "", "adapters": []}


# --- the GPU ------------------------------------------------------------------------------------


def test_a_torch_for_the_processor_is_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    assert gpu_here() == f"torch {torch.__version__} is a build for the processor"


def test_what_torch_warns_of_is_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def unavailable() -> bool:
        warnings.warn("The NVIDIA driver is too old (found 12060).\nUpdate it.", stacklevel=1)
        return False

    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", unavailable)
    reason = gpu_here()
    assert isinstance(reason, str)
    assert reason.endswith("sees no GPU (The NVIDIA driver is too old (found 12060).)")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert str(gpu_here()).endswith("with CUDA 13.0 sees no GPU")


def test_a_gpu_is_named_with_what_decides_whether_kernels_fit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    properties = SimpleNamespace(name="Orin", major=8, minor=7, total_memory=7_400_000_000)
    monkeypatch.setattr(torch.version, "cuda", "12.6")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: properties)
    monkeypatch.setattr(torch.cuda, "get_arch_list", lambda: ["sm_87"])
    found = gpu_here()
    assert found == Gpu("Orin", "8.7", 7.4, torch.__version__, "12.6", ("sm_87",))
    assert "compute capability 8.7, 7.4 GB" in str(found)
