"""What the doctor says of a GPU, for everything that can come of trying it; no GPU is needed."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import pytest
from rich.console import Console

from aquaflow.doctor import CheckResult, MachineProbes, print_findings, to_json
from aquaflow.doctor import machine as accelerator
from aquaflow.doctor.attempts import SOFTWARE, Attempt
from aquaflow.render.gsplat import Gpu

ORIN = Gpu("Orin", "8.7", 7.4, "2.8.0", "12.6", ("sm_87",))
DREW = Attempt(
    {
        "first_call_s": 35.24,
        "next_call_ms": 2.1,
        "difference_picture": 1e-4,
        "difference_gradients": 3e-4,
    }
)
RAN = Attempt({"first_call_s": 1.25, "next_call_ms": 3.4, "difference": 2e-5})
GOOD = {"gsplat": DREW, "cuda": RAN, "tensorrt": RAN}
OFFERED = ["TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"]
CPU_ONLY = ["AzureExecutionProvider", "CPUExecutionProvider"]


def found_on(
    gpu: Gpu | str = ORIN,
    providers: list[str] = OFFERED,
    driver: bool = True,
    **attempts: Attempt,
) -> dict[str, CheckResult]:
    """The findings by name, of a machine that is pretended."""
    outcomes, tried = {**GOOD, **attempts}, list[str]()

    def attempt(name: str) -> Attempt:
        tried.append(name)
        return outcomes[name]

    machine = MachineProbes(
        which=lambda name: "/usr/bin/nvidia-smi" if driver else None,
        gpu=lambda: gpu,
        onnx_providers=lambda: providers,
        attempt=attempt,
        module_present=lambda name: name in attempts,
    )
    found = {finding.name: finding for finding in accelerator.findings(machine)}
    assert len(tried) == len(found) - 1
    return found


def test_a_gpu_on_which_all_was_tried_and_right() -> None:
    found = found_on()
    assert list(found) == ["GPU", "gsplat", "ONNX Runtime, CUDA", "ONNX Runtime, TensorRT"]
    assert all(finding.ok for finding in found.values())
    assert found["GPU"].found == "Orin, compute capability 8.7, 7.4 GB, torch 2.8.0 with CUDA 12.6"
    assert found["gsplat"].found == (
        "drew a known scene and its gradients, 35.2 s the first time, then 2.1 ms; the picture is "
        "1.0e-04 of full scale from the reference's, the gradients 3.0e-04"
    )
    assert found["gsplat"].used_for == "maps are optimised on the GPU"
    assert found["ONNX Runtime, CUDA"].found == (
        "ran the compact prior, 1.2 s the first time, then 3.4 ms; 2.0e-05 from what the processor "
        "says"
    )


@pytest.mark.parametrize(
    ("attempt", "name", "instead"),
    [
        ("gsplat", "gsplat", "maps are drawn on the processor"),
        ("cuda", "ONNX Runtime, CUDA", "learned priors run on the processor"),
    ],
)
def test_what_failed_says_why_and_what_is_used_instead(
    attempt: str, name: str, instead: str
) -> None:
    found = found_on(**{attempt: Attempt(failed="no kernels; compile them")})
    assert found[name].used_for == instead
    assert found[name].advice == "no kernels; compile them"
    assert found[name].figures == {}
    assert [each.name for each in found.values() if not each.ok] == [name]


LAVAPIPE = "llvmpipe (CPU, Vulkan, Mesa 22.3.6)"
RADEON = "AMD Radeon 780M (IntegratedGPU, Vulkan, radv)"


def test_every_makers_gpu_is_tried_where_wgpu_is_installed() -> None:
    found = found_on("no CUDA", CPU_ONLY, False, wgpu=replace(DREW, adapters=(RADEON, LAVAPIPE)))
    assert list(found) == ["GPU", "WebGPU"]
    assert found["WebGPU"].ok
    assert found["WebGPU"].found.startswith(f"{RADEON} drew a known scene and its gradients")
    assert found["WebGPU"].found.endswith(f"; also {LAVAPIPE}")
    assert found["WebGPU"].used_for == "maps are drawn on it where that is the fastest"


def test_a_program_that_stands_in_for_a_gpu_is_said_to_be_one() -> None:
    program = Attempt({**DREW.figures, SOFTWARE: 1.0}, adapters=(LAVAPIPE,))
    found = found_on("no CUDA", CPU_ONLY, False, wgpu=program)
    assert "this is a program, and slower" in found["WebGPU"].used_for
    failed = found_on("no CUDA", CPU_ONLY, False, wgpu=Attempt(failed="it has no driver"))
    assert (failed["WebGPU"].found, failed["WebGPU"].advice) == (
        "does not draw",
        "it has no driver",
    )


def test_tensorrt_that_does_not_run_is_no_shortcoming_where_cuda_runs() -> None:
    finding = found_on(tensorrt=Attempt(failed="libnvinfer.so.10 is missing"))[
        "ONNX Runtime, TensorRT"
    ]
    assert finding.ok
    assert finding.found == "does not run: libnvinfer.so.10 is missing"
    assert finding.used_for == "CUDA is used in its place"


def test_tensorrt_is_not_tried_where_it_is_not_offered() -> None:
    assert list(found_on(providers=OFFERED[1:])) == ["GPU", "gsplat", "ONNX Runtime, CUDA"]


def test_an_onnxruntime_for_the_processor_is_found_out_beside_a_gpu() -> None:
    refusal = Attempt(failed="onnxruntime has no CUDAExecutionProvider; install onnxruntime-gpu")
    found = found_on(providers=CPU_ONLY, cuda=refusal)
    assert "install onnxruntime-gpu" in found["ONNX Runtime, CUDA"].advice


def test_without_a_gpu_nothing_is_tried() -> None:
    found = found_on("torch is a build for the processor", CPU_ONLY, driver=False)
    assert list(found) == ["GPU"]
    assert found["GPU"].found == "none"
    assert found["GPU"].ok


def test_a_driver_that_torch_cannot_use_gives_torchs_reason() -> None:
    reason = "torch 2.13.0 with CUDA 13.0 sees no GPU (the driver is too old)"
    finding = found_on(reason, CPU_ONLY)["GPU"]
    assert finding.found == "an NVIDIA driver, but torch cannot use the GPU"
    assert finding.advice.startswith(reason)
    assert finding.advice.endswith("install a build of torch that fits the driver")


def test_networks_are_tried_on_a_gpu_that_only_onnxruntime_can_reach() -> None:
    found = found_on("torch 2.13.0+cpu is a build for the processor", OFFERED)
    assert list(found) == ["GPU", "ONNX Runtime, CUDA"]
    assert found["ONNX Runtime, CUDA"].used_for == "learned priors run on the GPU"


def test_the_drivers_version_is_in_the_report(tmp_path) -> None:
    file = tmp_path / "proc" / "driver" / "nvidia" / "version"
    file.parent.mkdir(parents=True)
    file.write_text("NVRM version: NVIDIA UNIX x86_64 Kernel Module  580.159.03  Tue Jan 6\n")
    machine = MachineProbes(
        root=tmp_path,
        gpu=lambda: ORIN,
        onnx_providers=list,
        attempt=GOOD.__getitem__,
        module_present=lambda _: False,
    )
    assert accelerator.findings(machine)[0].found.endswith("CUDA 12.6, driver 580.159.03")
    silent = replace(machine, root=tmp_path / "other", which=lambda name: None)
    assert silent.driver() == ""
    assert accelerator.findings(replace(silent, gpu=lambda: "none"))[0].found == "none"
    assert not accelerator.findings(replace(machine, gpu=lambda: "none"))[0].ok


def test_numbers_are_in_the_json_and_sentences_in_the_table() -> None:
    findings = list(found_on(cuda=Attempt(failed="it crashed (SIGSEGV): it said nothing")).values())
    rows = {row["name"]: row for row in json.loads(json.dumps(to_json(findings)))["findings"]}
    assert rows["gsplat"]["figures"] == DREW.figures
    assert rows["gsplat"]["ok"]
    assert rows["ONNX Runtime, CUDA"]["figures"] == {}
    assert not rows["ONNX Runtime, CUDA"]["ok"]
    text = io.StringIO()
    print_findings(findings, Console(file=text, width=300))
    assert "35.2 s the first time" in text.getvalue()
    assert "it crashed (SIGSEGV)" in text.getvalue()
