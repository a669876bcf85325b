"""constraints.txt: one set of wheels for every Python and processor that the README names."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
TARGETS = [(python, machine) for python in PYTHONS for machine in ("x86_64", "aarch64")]
EXTRAS = ("dev", "lpips", "oak", "peers", "prior-peers", "s3-tests")
"""Everything but ``gpu``, whose gsplat is installed without what it asks for, and ``prior-gpu``,
which stands in ``prior``'s place and exists for fewer of them."""
CUDA_BUILD_OF_TORCH = re.compile(r"nvidia-|cuda-|triton$")
"""What the CUDA build of torch pins itself."""
CPU_TORCH = "torch-2.13.0+cpu-cp312-cp312-manylinux_2_28_aarch64.whl"
UV = (sys.executable, "-m", "uv")

pytestmark = pytest.mark.ci


def uv_compile(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*UV, "pip", "compile", "--quiet", "--no-header", "--no-annotate", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "UV_NO_CONFIG": "1"},
        cwd=folder,
    )


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Skips where uv or a package index is missing."""
    folder = tmp_path_factory.mktemp("index")
    (folder / "one.in").write_text("threadpoolctl\n")
    ran = uv_compile(folder, "one.in", "--refresh-package", "threadpoolctl")
    if ran.returncode != 0:
        reason = ran.stderr.strip().splitlines() or ["uv says nothing"]
        pytest.skip(f"no package index to resolve from: {reason[-1].strip()}")


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def pins() -> set[tuple[str, str]]:
    """Every (name, version) in constraints.txt, whatever its marker."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    rows = (line.partition(";")[0].split("==") for line in lines if not line.startswith("#"))
    return {(normal(name), version.strip()) for name, version in rows}


def resolve(target: tuple[str, str]) -> subprocess.CompletedProcess[str]:
    """What constraints.txt gives one (Python, processor), from wheels alone."""
    python, machine = target
    extras = [part for extra in EXTRAS for part in ("--extra", extra)]
    wheels = ("--only-binary", ":all:", "-c", "constraints.txt")
    platform = ("--python-version", python, "--python-platform", f"{machine}-manylinux_2_28")
    return uv_compile(ROOT, "pyproject.toml", *extras, *wheels, *platform)


@pytest.fixture(scope="module")
def resolved(index: None) -> dict[tuple[str, str], subprocess.CompletedProcess[str]]:
    """Every target's run; at once, because they wait for the index most of the time."""
    with ThreadPoolExecutor(len(TARGETS)) as pool:
        return dict(zip(TARGETS, pool.map(resolve, TARGETS), strict=True))


@pytest.mark.parametrize("target", TARGETS, ids="-".join)
def test_every_python_and_processor_gets_pinned_wheels(
    resolved: dict[tuple[str, str], subprocess.CompletedProcess[str]], target: tuple[str, str]
) -> None:
    ran = resolved[target]
    assert ran.returncode == 0, ran.stderr
    rows = (line.partition(";")[0].split("==") for line in ran.stdout.splitlines())
    found = {(normal(name), version.strip()) for name, version in rows}
    assert ("torch", "2.13.0") in found
    assert {row for row in found - pins() if not CUDA_BUILD_OF_TORCH.match(row[0])} == set()


def cpu_pins(folder: Path) -> Path:
    """constraints.txt as install.sh pins it for a machine without a GPU."""
    pins_file = folder / "pins.txt"
    shutil.copy(ROOT / "constraints.txt", pins_file)
    script = f'source "{ROOT}/deploy/torch.sh"; pin_torch cpu python3 "{pins_file}"'
    subprocess.run(["bash", "-euc", script], check=True)
    return pins_file


def torch_for_cpu(folder: Path) -> Path:
    """A folder with the name and metadata of PyTorch's wheel for processors, and nothing in it."""
    wheels = folder / "wheels"
    wheels.mkdir()
    with zipfile.ZipFile(wheels / CPU_TORCH, "w") as wheel:
        info = "torch-2.13.0+cpu.dist-info"
        wheel.writestr(
            f"{info}/METADATA", "Metadata-Version: 2.1\nName: torch\nVersion: 2.13.0+cpu\n"
        )
        wheel.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nTag: cp312-cp312-manylinux_2_28_aarch64\n"
        )
        wheel.writestr(f"{info}/RECORD", "")
    return wheels


@pytest.mark.usefixtures("index")
def test_an_onboard_install_takes_no_cuda_whatever_the_index_holds(tmp_path: Path) -> None:
    target = ("--python-version", "3.12", "--python-platform", "aarch64-manylinux_2_28")
    pinned = ("pyproject.toml", "--only-binary", ":all:", "-c", str(cpu_pins(tmp_path)), *target)
    without = uv_compile(ROOT, *pinned)
    assert without.returncode != 0
    assert "torch==2.13.0+cpu" in without.stderr
    given = uv_compile(ROOT, *pinned, "--find-links", str(torch_for_cpu(tmp_path)))
    assert given.returncode == 0, given.stderr
    assert "torch==2.13.0+cpu" in given.stdout
    assert not [row for row in given.stdout.splitlines() if CUDA_BUILD_OF_TORCH.match(row)]
