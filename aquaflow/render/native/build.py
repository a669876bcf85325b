"""Compile the C++ kernels: one shared library per instruction set.

Standard library only, so that ``setup.py`` can load this file before anything is installed. The
source's hash is compiled into each library; a library whose hash differs is out of date, whatever
the clocks of wheels and checkouts say.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

NATIVE_DIR = Path(__file__).resolve().parent
SOURCE = "aquaflow_native.cpp"

ISA_FLAGS: dict[str, tuple[str, ...]] = {
    "avx512": ("-march=x86-64-v4", "-mprefer-vector-width=512"),
    "avx2": ("-march=x86-64-v3",),
    "sse4": ("-march=x86-64-v2",),
    "neon": ("-march=armv8-a",),
}
"""Instruction sets by name, fastest first within an architecture."""

COMPILE_FLAGS = (
    "-std=c++17",
    "-O3",
    "-fPIC",
    "-fvisibility=hidden",  # several variants may be loaded into one process
    "-fvisibility-inlines-hidden",
    "-fopenmp-simd",  # the pragma only: no OpenMP runtime
    # The parts of -ffast-math that leave NaN and infinity alone: the guards depend on them.
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fassociative-math",
    "-freciprocal-math",
    "-ffp-contract=fast",
)
LINK_FLAGS = ("-shared", "-pthread")
"""Never -ffast-math here: a library linked with it switches denormals off in the whole process."""

CPU_FLAGS = {
    "avx512": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "avx2", "fma", "bmi2"},
    "avx2": {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"},
    "sse4": {"sse4_1", "sse4_2", "ssse3", "popcnt"},
}
"""What /proc/cpuinfo must list."""


class BuildError(RuntimeError):
    """The kernels cannot be compiled; the message is one sentence."""


def buildable_isas() -> tuple[str, ...]:
    """Variants that make sense on this architecture, fastest first."""
    machine = platform.machine().lower()
    if machine in {"x86_64", "amd64"}:
        return ("avx512", "avx2", "sse4")
    return ("neon",) if machine in {"aarch64", "arm64"} else ()


def supported_isas(cpuinfo: Path = Path("/proc/cpuinfo")) -> tuple[str, ...]:
    """Variants that this processor runs, fastest first."""
    isas = buildable_isas()
    if "neon" in isas:
        return isas  # part of every 64-bit Arm processor
    try:
        lines = cpuinfo.read_text().splitlines()
    except OSError:
        return isas[-1:]
    flags = set(next((line for line in lines if line.startswith("flags")), "").split())
    return tuple(isa for isa in isas if flags >= CPU_FLAGS[isa])


def source_hash(directory: Path = NATIVE_DIR) -> str:
    """Hash of the sources and of the flags they are compiled with."""
    digest = hashlib.sha256(repr((ISA_FLAGS, COMPILE_FLAGS, LINK_FLAGS)).encode())
    for path in sorted([directory / SOURCE, *directory.glob("*.h")]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def library_path(isa: str, directory: Path = NATIVE_DIR) -> Path:
    return directory / f"libaquaflow_{isa}.so"


def is_current(library: Path) -> bool:
    """Whether ``library`` exists and was built from the sources beside this file."""
    try:
        return f"aquaflow-source:{source_hash()}".encode() in library.read_bytes()
    except OSError:
        return False


def find_compiler() -> list[str] | None:
    """The C++ compiler as a command: $CXX, else g++, clang++ or c++; None if there is none."""
    chosen = shlex.split(os.environ.get("CXX", ""))
    for command in [chosen] if chosen else [["g++"], ["clang++"], ["c++"]]:
        if shutil.which(command[0]):
            return command
    return None


def build(isa: str, out_dir: Path) -> Path:
    """Compile the variant ``isa`` into ``out_dir``; the finished file appears in one step.

    Raises BuildError when there is no compiler, it fails, or ``out_dir`` cannot be written.
    """
    compiler = find_compiler()
    if compiler is None:
        raise BuildError("no C++ compiler was found; install g++ or clang++, or set CXX")
    target = library_path(isa, out_dir)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".build-", dir=out_dir) as scratch:
            obj, library = Path(scratch) / "native.o", Path(scratch) / target.name
            macro = f'-DAQ_SOURCE_HASH="{source_hash()}"'
            source = str(NATIVE_DIR / SOURCE)
            flags = (*COMPILE_FLAGS, *ISA_FLAGS[isa], macro)
            _run([*compiler, *flags, "-c", source, "-o", str(obj)])
            _run([*compiler, *LINK_FLAGS, str(obj), "-o", str(library)])
            os.replace(library, target)
    except OSError as error:
        raise BuildError(f"the kernels cannot be written to {out_dir}: {error}") from error
    return target


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise BuildError(
            f"`{command[0]}` failed on {SOURCE}: {last}; check the compiler, or set CXX"
        )
