"""What the processor can do at most: a loop of nothing but independent fused multiply-adds.

Rates are per CPU time, so that other programs on the machine do not lower the mark.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import torch

from aquaflow.lab.bench.render.contenders import BlendLimit
from aquaflow.render.native import build

VECTOR_BYTES = {"avx512": 64, "avx2": 32, "sse4": 16, "neon": 16}
"""Of a vector register."""
CHAINS = 12
"""Independent accumulators: more than latency times units of any processor of these."""
STEPS = 1_000_000
ATTEMPTS = 8
MATRIX = 1024
"""Rounds of the loop, attempts, rows of a matrix: long enough to time, and the best attempt
counts."""

SOURCE = """
typedef float Vector __attribute__((vector_size(BYTES)));
extern "C" __attribute__((visibility("default"))) float multiply_add(long steps) {
  Vector sum[CHAINS];
  for (int i = 0; i < CHAINS; i++) sum[i] = Vector{} + (float)i;
  const Vector factor = Vector{} + 0.999999f, term = Vector{} + 1e-6f;
  for (long step = 0; step < steps; step++) {
#pragma GCC unroll 16
    for (int i = 0; i < CHAINS; i++) sum[i] = sum[i] * factor + term;
  }
  Vector all{};
  for (int i = 0; i < CHAINS; i++) all += sum[i];
  return all[0];
}
"""
"""Multiplies and adds, and touches no memory."""


@dataclass(frozen=True)
class PeakRate:
    """Highest rate seen, for each number of threads, and how it was found."""

    flop_per_s: dict[int, float]
    method: str
    blending: Mapping[str, BlendLimit] = field(default_factory=dict)
    """By instruction set, what one thread of the kernels blends at most; those that were
    measured."""


def measure_peak(threads: tuple[int, ...]) -> PeakRate:
    """The fastest instruction set's peak; of matrix products where nothing can be compiled."""
    isas = build.supported_isas()
    with tempfile.TemporaryDirectory() as folder:
        try:
            work = _multiply_add(isas[0], Path(folder))
            method = f"a compiled {isas[0]} multiply-add loop"
        except (build.BuildError, OSError, IndexError, subprocess.CalledProcessError):
            work, method = _matrix_product(), f"torch products of {MATRIX} x {MATRIX} matrices"
        return PeakRate({count: _fastest(work, count) for count in threads}, method)


Work = Callable[[], float]
"""Does a stretch of work on the calling thread and returns its floating-point operations."""


def _multiply_add(isa: str, folder: Path) -> Work:
    compiler = build.find_compiler()
    if compiler is None:
        raise build.BuildError("no C++ compiler was found; install g++ or clang++, or set CXX")
    source, library = folder / "peak.cpp", folder / "peak.so"
    width = VECTOR_BYTES[isa]
    source.write_text(SOURCE)
    flags = (*build.compile_flags(isa), "-shared", f"-DBYTES={width}", f"-DCHAINS={CHAINS}")
    subprocess.run(
        [*compiler, *flags, str(source), "-o", str(library)], check=True, capture_output=True
    )
    loop = ctypes.CDLL(str(library)).multiply_add
    loop.argtypes, loop.restype = [ctypes.c_long], ctypes.c_float

    def work() -> float:
        loop(STEPS)  # ctypes releases Python's lock meanwhile
        return 2.0 * STEPS * CHAINS * width / 4.0

    return work


def _matrix_product() -> Work:
    a = torch.rand(MATRIX, MATRIX)

    def work() -> float:
        torch.matmul(a, a)
        return 2.0 * MATRIX**3

    return work


def _fastest(work: Work, threads: int) -> float:
    """Operations/s of ``threads`` threads at once: each one's best, by its own CPU time."""

    def best(_: int) -> float:
        rates: list[float] = []
        for _attempt in range(ATTEMPTS):
            begin = time.thread_time()
            operations = work()
            rates.append(operations / max(time.thread_time() - begin, 1e-9))
        return max(rates)

    before = torch.get_num_threads()
    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return sum(pool.map(best, range(threads)))
    finally:
        torch.set_num_threads(before)
