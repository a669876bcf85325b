"""deploy/torch.sh: which build of torch an installation gets, and that it gets no other."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / "deploy" / "torch.sh"


def program(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/bash\n{text}\n")
    path.chmod(0o755)
    return path


def bash(command: str, *arguments: object, path: str = "/usr/bin:/bin") -> tuple[str, str]:
    """What ``command`` of the library writes to stdout and to stderr."""
    script = f'set -euo pipefail; source "{LIBRARY}"; {command} "$@"'
    ran = subprocess.run(
        ["bash", "-c", script, "test", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=True,
        env={"PATH": path},
    )
    return ran.stdout.strip(), ran.stderr.strip()


@pytest.mark.parametrize(
    ("jetson", "torch_has_gpu", "nvidia", "build", "said"),
    [
        (False, False, False, "cpu", "no NVIDIA GPU here"),
        (False, False, True, "cuda", "nvidia-smi names a GPU"),
        (True, True, False, "system", "the Jetson's GPU"),
        (True, False, False, "cpu", "no torch that reaches the Jetson's GPU"),
    ],
)
def test_the_build_fits_the_machine_and_the_reason_is_said(
    tmp_path: Path, jetson: bool, torch_has_gpu: bool, nvidia: bool, build: str, said: str
) -> None:
    python = program(tmp_path / "python3", f"exit {int(not torch_has_gpu)}")
    answer = "echo 'GPU 0: one'" if nvidia else "echo 'no driver'; exit 9"
    program(tmp_path / "bin" / "nvidia-smi", answer)
    if jetson:
        program(tmp_path / "etc" / "nv_tegra_release", "# R36")
    path = f"{tmp_path / 'bin'}:/usr/bin:/bin"
    chosen, reason = bash("choose_torch", python, "auto", tmp_path, path=path)
    assert chosen == build
    assert said in reason


@pytest.mark.parametrize("build", ["cpu", "cuda", "system"])
def test_what_is_asked_for_is_taken(tmp_path: Path, build: str) -> None:
    assert bash("choose_torch", "/nonexistent", build, tmp_path)[0] == build


@pytest.mark.parametrize(
    ("build", "torch", "numpy"),
    [("cpu", "2.13.0+cpu", True), ("cuda", "2.13.0", True), ("system", "2.8.0a0+nv", False)],
)
def test_the_pins_admit_that_build_alone(
    tmp_path: Path, build: str, torch: str, numpy: bool
) -> None:
    pins = tmp_path / "pins.txt"
    shutil.copy(ROOT / "constraints.txt", pins)
    bash("pin_torch", build, program(tmp_path / "python3", "echo torch==2.8.0a0+nv"), pins)
    lines = pins.read_text().splitlines()
    assert [line for line in lines if line.startswith("torch==")] == [f"torch=={torch}"]
    assert any(line.startswith("numpy==") for line in lines) == numpy


@pytest.mark.parametrize(("machine", "bits"), [("armv7l", 32), ("aarch64", 32), ("i686", 32)])
def test_a_32_bit_system_is_refused_in_a_sentence(tmp_path: Path, machine: str, bits: int) -> None:
    python = program(
        tmp_path / "python3", f"[[ $2 == *calcsize* ]] && echo {machine} {bits}; exit 0"
    )
    script = ROOT / "deploy" / "install.sh"
    ran = subprocess.run(
        [script, "--python", python, "--root", tmp_path],
        capture_output=True,
        text=True,
        check=False,
    )
    if "run me as root" in ran.stderr:
        pytest.skip("only root may install")
    assert ran.returncode == 1
    assert "64-bit system" in ran.stderr
    assert f"{machine} {bits}" in ran.stderr
    assert not (tmp_path / "opt").exists()
