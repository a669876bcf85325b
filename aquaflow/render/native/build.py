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
"""What is compiled, in this folder; the headers next to it are included."""

X86_64_V2 = {
    "cx16": "-mcx16",
    "lahf_lm": "-msahf",
    "popcnt": "-mpopcnt",
    "sse4_1": "-msse4.1",
    "sse4_2": "-msse4.2",
    "ssse3": "-mssse3",
}
"""Linux flag names and compiler options of the psABI level."""
X86_64_V3 = X86_64_V2 | {
    "abm": "-mlzcnt",
    "avx2": "-mavx2",
    "bmi1": "-mbmi",
    "bmi2": "-mbmi2",
    "f16c": "-mf16c",
    "fma": "-mfma",
    "movbe": "-mmovbe",
}
"""The same for the next level: AVX2, FMA."""
X86_64_V4 = X86_64_V3 | {
    "avx512bw": "-mavx512bw",
    "avx512cd": "-mavx512cd",
    "avx512dq": "-mavx512dq",
    "avx512f": "-mavx512f",
    "avx512vl": "-mavx512vl",
}
"""Levels of the x86-64 psABI: name in /proc/cpuinfo -> compiler flag. One table for both, so that a
library holds no instruction that is not looked for; compilers before -march=x86-64-v3 (GCC 11,
clang 12) know these flags too."""

CPU_FLAGS = {"avx512": X86_64_V4, "avx2": X86_64_V3, "sse4": X86_64_V2, "neon": {}}
"""What a library may use, and /proc/cpuinfo must list."""

EXTRA_FLAGS = {"avx512": ("-mprefer-vector-width=512",), "neon": ("-march=armv8-a",)}
"""What the variant needs on top of its instructions: GCC uses half of AVX-512 unless asked."""

ISAS = {
    "x86_64": ("avx512", "avx2", "sse4"),
    "amd64": ("avx512", "avx2", "sse4"),
    "aarch64": ("neon",),
    "arm64": ("neon",),
}
"""Variants by architecture, as the operating system or the compiler calls it, fastest first."""

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
"""The same for every variant."""
LINK_FLAGS = ("-shared", "-pthread")
"""Never -ffast-math here: a library linked with it switches denormals off in the whole process."""


class BuildError(RuntimeError):
    """The kernels cannot be compiled; the message is one sentence."""


def target_machine(compiler: list[str]) -> str:
    """Architecture that ``compiler`` builds for, as in x86_64 or aarch64.

    That is the machine's own unless it is a cross compiler such as ``aarch64-linux-gnu-g++``.
    """
    asked = subprocess.run(
        [*compiler, "-dumpmachine"], capture_output=True, text=True, errors="replace", check=False
    )
    triplet = asked.stdout.strip() if asked.returncode == 0 else platform.machine()
    return triplet.partition("-")[0].lower()


def target_isas(compiler: list[str]) -> tuple[str, ...]:
    """Variants of the architecture that ``compiler`` builds for, fastest first."""
    return ISAS.get(target_machine(compiler), ())


def supported_isas(cpuinfo: Path = Path("/proc/cpuinfo")) -> tuple[str, ...]:
    """Variants that this processor runs, fastest first."""
    isas = ISAS.get(platform.machine().lower(), ())
    if "neon" in isas:
        return isas  # part of every 64-bit Arm processor
    try:
        lines = cpuinfo.read_text().splitlines()
    except OSError:
        return isas[-1:]
    flags = set(next((line for line in lines if line.startswith("flags")), "").split())
    return tuple(isa for isa in isas if flags >= CPU_FLAGS[isa].keys())


def source_hash(directory: Path = NATIVE_DIR) -> str:
    """Hash of the sources and of the flags they are compiled with."""
    digest = hashlib.sha256(repr((CPU_FLAGS, EXTRA_FLAGS, COMPILE_FLAGS, LINK_FLAGS)).encode())
    for path in sorted([directory / SOURCE, *directory.glob("*.h")]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def library_path(isa: str, directory: Path = NATIVE_DIR) -> Path:
    """Where the library of the variant ``isa`` lies."""
    return directory / f"libaquaflow_{isa}.so"


def is_current(library: Path) -> bool:
    """Whether ``library`` exists and was built from the sources in this folder."""
    try:
        expected = f"aquaflow-source:{source_hash()}".encode()
    except OSError:  # what cannot be read cannot be built again either
        return library.exists()
    try:
        return expected in library.read_bytes()
    except OSError:
        return False


def find_compiler() -> list[str] | None:
    """The C++ compiler as a command: $CXX, else g++, clang++ or c++; None if there is none."""
    chosen = shlex.split(os.environ.get("CXX", ""))
    for command in [chosen] if chosen else [["g++"], ["clang++"], ["c++"]]:
        if shutil.which(command[0]):
            return command
    return None


def compile_flags(isa: str) -> list[str]:
    """How the sources are compiled for the variant ``isa``."""
    instructions = [*CPU_FLAGS[isa].values(), *EXTRA_FLAGS.get(isa, ())]
    return [*COMPILE_FLAGS, *instructions, f'-DAQ_SOURCE_HASH="{source_hash()}"']


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
            source = str(NATIVE_DIR / SOURCE)
            _run([*compiler, *compile_flags(isa), "-c", source, "-o", str(obj)])
            _run([*compiler, *LINK_FLAGS, str(obj), "-o", str(library)])
            os.replace(library, target)
    except OSError as error:
        raise BuildError(f"the kernels cannot be written to {out_dir}: {error}") from error
    return target


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["no message"]
        cause = next((line for line in lines if "error" in line), lines[-1])
        raise BuildError(
            f"`{command[0]}` failed on {SOURCE}: {cause}; check the compiler, or set CXX"
        )
