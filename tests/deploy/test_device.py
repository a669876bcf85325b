"""install.sh --device: which wheels from where, and what is compiled; nothing is installed."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
INSTALL = ROOT / "deploy" / "install.sh"
JETSON_TORCH = "torch @ https://pypi.jetson-ai-lab.io/jp6/cu126/+f/62a/1beee9f2f1470/torch-2.8.0-"
JETSON_NETWORKS = (
    "onnxruntime-gpu @ https://pypi.jetson-ai-lab.io/jp6/cu126/+f/d98/0b934b9a29c1a/"
    "onnxruntime_gpu-1.24.0-"
)


@dataclass
class Machine:
    """A machine of programs that answer as its own would."""

    folder: Path
    python: tuple[int, int] = (3, 12)
    kind: str = "x86_64 64"
    gpu: str | None = None
    """Compute capability that nvidia-smi names."""
    nvcc: bool = True
    torch_reaches_gpu: bool = False
    given: list[str] = field(default_factory=list)

    def program(self, name: str, text: str) -> Path:
        path = self.folder / "bin" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"#!/bin/bash\n{text}\n")
        path.chmod(0o755)
        return path

    def install(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        major, minor = self.python
        python = self.program(
            "python3",
            f"case $2 in\n"
            f"*calcsize*) echo {self.kind} ;;\n"
            f"*base_prefix*) echo /usr ;;\n"
            f"*cuda.is_available*) exit {int(not self.torch_reaches_gpu)} ;;\n"
            f"*'[:2] != (3, 10)'*) exit {int((major, minor) != (3, 10))} ;;\n"
            f"*'(3, 11)'*) exit {int((major, minor) < (3, 11))} ;;\n"
            f"*) exit 0 ;;\nesac",
        )
        asked = f"[[ $1 == *compute_cap* ]] && echo {self.gpu} || echo 'GPU 0: one'"
        self.program("nvidia-smi", asked if self.gpu else "exit 9")
        if self.nvcc:
            self.program("nvcc", "exit 0")
        path = f"{self.folder / 'bin'}:/usr/bin:/bin"
        command = [INSTALL, "--dry-run", "--python", python, "--root", self.folder, *arguments]
        return subprocess.run(
            list(map(str, command)),
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "PATH": path, "CUDA_HOME": str(self.folder / "cuda")},
        )


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def orin(folder: Path) -> Machine:
    return Machine(folder, python=(3, 10), kind="aarch64 64")


def plan(machine: Machine, *arguments: str) -> list[str]:
    """What would be done, a line for each step."""
    ran = machine.install(*arguments)
    assert ran.returncode == 0, ran.stderr
    assert not (machine.folder / "opt").exists()
    return (
        ran.stdout.replace(str(machine.folder), "ROOT").replace(str(ROOT), "CHECKOUT").splitlines()
    )


PIP = (
    "+ ROOT/opt/aquaflow/venv/bin/python -m pip --disable-pip-version-check --no-cache-dir "
    "install --quiet"
)
PINS = "--constraint ROOT/opt/aquaflow/share/constraints.txt"


def test_without_a_gpu_nothing_but_the_wheels_for_processors_is_taken(machine: Machine) -> None:
    machine.nvcc = False
    assert plan(machine) == [
        "install.sh: device cpu, torch cpu, extras prior,telemetry,recording",
        "+ install -d -m 0755 ROOT/opt/aquaflow ROOT/opt/aquaflow/share",
        "+ ROOT/bin/python3 -m venv ROOT/opt/aquaflow/venv",
        "+ install -m 0644 CHECKOUT/constraints.txt ROOT/opt/aquaflow/share/constraints.txt",
        "+ pin_torch cpu ROOT/bin/python3 ROOT/opt/aquaflow/share/constraints.txt",
        f"{PIP} --extra-index-url https://download.pytorch.org/whl/cpu {PINS} --upgrade "
        "CHECKOUT[prior,telemetry,recording]",
        "+ install -m 0644 CHECKOUT/deploy/README.md ROOT/opt/aquaflow/share/README.md",
    ]


def test_a_gpu_of_any_maker_gets_wgpu_and_the_wheels_for_processors(machine: Machine) -> None:
    said, *steps = plan(machine, "--device", "any")
    assert said == "install.sh: device any, torch cpu, extras prior,telemetry,recording,gpu-any"
    (aquaflow,) = (step for step in steps if "pip" in step)
    assert aquaflow.endswith("CHECKOUT[prior,telemetry,recording,gpu-any]")
    assert plan(machine, "--device", "any", "--extras", "")[0].endswith("extras gpu-any")


def test_a_gpu_gets_onnxruntimes_build_for_it_and_gsplat_compiled_for_it(machine: Machine) -> None:
    machine.gpu = "8.6"
    said, *steps = plan(machine)
    assert said == ("install.sh: device cuda, torch cuda, extras prior-gpu,telemetry,recording")
    aquaflow, builders, gsplat = (step for step in steps if "pip" in step)
    assert aquaflow == f"{PIP} {PINS} --upgrade CHECKOUT[prior-gpu,telemetry,recording]"
    assert builders == f"{PIP} {PINS} setuptools ninja"
    assert re.fullmatch(
        r"\+ env PATH=ROOT/opt/aquaflow/venv/bin:ROOT/bin:\S+ TORCH_CUDA_ARCH_LIST=8\.6 "
        rf"MAX_JOBS=2 {re.escape(PIP[2:])} {PINS} --force-reinstall --no-deps "
        r"--no-build-isolation --use-pep517 --no-binary gsplat gsplat",
        gsplat,
    )


def test_a_jetson_gets_the_wheels_that_pypi_does_not_have(tmp_path: Path) -> None:
    said, *steps = plan(orin(tmp_path), "--device", "jetson")
    assert "device jetson, torch jetson" in said
    aquaflow, _, gsplat = (step for step in steps if "pip" in step)
    assert JETSON_TORCH in aquaflow
    assert JETSON_NETWORKS in aquaflow
    assert "CHECKOUT[prior-gpu,telemetry,recording]" in aquaflow
    hashes = re.findall(r"\.whl#sha256=([0-9a-f]+)", aquaflow)
    assert [len(each) for each in hashes] == [64, 64]
    assert "TORCH_CUDA_ARCH_LIST=8.7 " in gsplat


def test_a_jetsons_own_torch_stays(tmp_path: Path) -> None:
    jetson = orin(tmp_path)
    jetson.torch_reaches_gpu = True
    said, *steps = plan(jetson, "--device", "jetson")
    assert "device jetson, torch system" in said
    assert "+ ROOT/bin/python3 -m venv --system-site-packages ROOT/opt/aquaflow/venv" in steps
    assert not [step for step in steps if JETSON_TORCH in step]
    assert [step for step in steps if JETSON_NETWORKS in step]


def test_the_wheels_for_jetpack_6_are_refused_for_another_python(tmp_path: Path) -> None:
    jetson = orin(tmp_path)
    jetson.python = (3, 12)
    ran = jetson.install("--device", "jetson")
    assert ran.returncode == 1
    assert "are for Python 3.10" in ran.stderr


def test_without_nvcc_maps_stay_on_the_processor_and_that_is_said(machine: Machine) -> None:
    machine.gpu, machine.nvcc = "8.6", False
    ran = machine.install()
    assert ran.returncode == 0
    assert "there is no nvcc: maps are drawn on the processor" in ran.stderr
    assert "gsplat" not in ran.stdout


def test_an_old_python_keeps_its_networks_on_the_processor(machine: Machine) -> None:
    machine.gpu, machine.python = "8.6", (3, 10)
    ran = machine.install()
    assert "onnxruntime-gpu for CUDA 13 needs Python 3.11" in ran.stderr
    assert "extras prior,telemetry" in ran.stdout


@pytest.mark.parametrize(
    ("extras", "taken"),
    [
        ("prior", "prior-gpu"),
        ("telemetry,prior", "telemetry,prior-gpu"),
        ("prior-peers,survey", "prior-peers,survey"),
        ("", "none"),
    ],
)
def test_only_onnxruntimes_extra_changes(machine: Machine, extras: str, taken: str) -> None:
    assert plan(machine, "--device", "cuda", "--extras", extras)[0].endswith(f"extras {taken}")


def test_a_wheelhouse_holds_nothing_for_a_gpu_beyond_torch(machine: Machine) -> None:
    machine.gpu = "8.6"
    wheels = machine.folder / "wheels"
    wheels.mkdir()
    ran = machine.install("--wheelhouse", str(wheels))
    assert "onnxruntime-gpu and gsplat are not in a wheelhouse" in ran.stderr
    assert "device cpu, torch cuda, extras prior,telemetry" in ran.stdout
    assert "--no-index" in ran.stdout
    assert "gsplat" not in ran.stdout


def test_torch_can_be_chosen_apart_from_the_device(machine: Machine) -> None:
    assert "device cpu, torch cuda" in plan(machine, "--device", "cpu", "--torch", "cuda")[0]


def test_a_device_that_does_not_exist_is_refused(machine: Machine) -> None:
    ran = machine.install("--device", "tpu")
    assert ran.returncode == 1
    assert "--device is auto, cpu, any, cuda or jetson, not tpu" in ran.stderr


def test_the_jetsons_torch_is_the_one_that_is_pinned(tmp_path: Path) -> None:
    pins = tmp_path / "pins.txt"
    pins.write_text("torch==2.13.0\nnumpy==2.2.6\n")
    script = f'source "{ROOT}/deploy/device.sh"; source "{ROOT}/deploy/torch.sh"; "$@"'
    subprocess.run(
        ["bash", "-euc", script, "test", "pin_torch", "jetson", "python3", str(pins)], check=True
    )
    assert pins.read_text() == "torch==2.8.0\nnumpy==2.2.6\n"
    assert "torch-2.8.0-" in JETSON_TORCH
