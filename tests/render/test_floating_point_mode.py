"""Loading and running the kernels changes no floating-point mode of the process.

A library linked with -ffast-math would: every number below 1.2e-38 becomes zero from then on.
"""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from aquaflow.render.adam import SelectiveAdam
from aquaflow.render.library import load_library
from aquaflow.render.native import build as native

SHOW_MODES = """
import ctypes, sys, threading
import numpy as np
import torch
from aquaflow.render.cpu import CpuRenderer

libm = ctypes.CDLL("libm.so.6")

def mode():
    # fegetenv: the whole floating-point environment (C99 7.6); its control word without the flags
    # of exceptions that arithmetic raised meanwhile, and arithmetic on denormals itself.
    env = (ctypes.c_uint32 * 16)()
    assert libm.fegetenv(env) == 0
    control = env[7] & ~0x3F if ENVIRONMENT == "x86" else env[0]
    small, tiny = np.float32([1e-20]), np.float32([1e-40])
    return control, (small * small).tobytes(), (tiny * np.float32(1e10)).tobytes()

def mode_of_new_thread():
    modes = []
    thread = threading.Thread(target=lambda: modes.append(mode()))
    thread.start(); thread.join()
    return modes[0]

before = mode()
assert np.frombuffer(before[1], np.float32)[0] > 0 and np.frombuffer(before[2], np.float32)[0] > 0
for isa in sys.argv[1:]:
    renderer = CpuRenderer(3, isa)
    assert mode() == before == mode_of_new_thread(), "loading " + isa
    n = 5000
    tensors = [torch.rand(n, 3), torch.rand(n, 4), torch.rand(n, 3) / 100, torch.rand(n),
               torch.rand(n, 3), torch.eye(4)]
    leaves = [tensor.requires_grad_() for tensor in tensors]
    out = renderer(*leaves, torch.diag(torch.tensor([50.0, 50.0, 1.0])), 64, 48)
    (out.image.sum() + out.alpha.sum()).backward()
    assert mode() == before == mode_of_new_thread(), "running " + isa
"""


@pytest.mark.skipif(native.find_compiler() is None, reason="no C++ compiler")
@pytest.mark.skipif(sys.platform != "linux", reason="reads glibc's floating-point environment")
def test_loading_and_running_every_variant_changes_no_mode() -> None:
    isas = native.supported_isas()
    environment = "arm" if "neon" in isas else "x86"
    code = f"ENVIRONMENT = {environment!r}\n{SHOW_MODES}"
    done = subprocess.run(
        [sys.executable, "-c", code, *isas], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(native.find_compiler() is None, reason="no C++ compiler")
@pytest.mark.parametrize("isa", native.supported_isas())
def test_the_pools_threads_keep_denormal_numbers(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    library = load_library(isa)
    monkeypatch.setattr("aquaflow.render.adam.library_or_none", lambda: library)
    rows = 4096  # cut into runs of rows, one for every thread
    adam = SelectiveAdam({"means": (torch.zeros(rows, 3), 1e-3)}, threads=4)
    adam.step(torch.ones(rows, dtype=torch.bool), {"means": torch.full((rows, 3), 1e-20)})
    assert (adam.second_moments["means"] > 0).all()  # 1e-43, a denormal, in every thread's rows
