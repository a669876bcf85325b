"""What the doctor tries on a GPU, each in a process of its own, so that a crash is a finding too.

``python -m aquaflow.doctor.attempts NAME`` prints as its last line, in JSON, what was measured or
the sentence why there is nothing to measure. Only the first call in a process finds kernels that
must be compiled, libraries that must be loaded and engines that must be built: it is timed apart.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from aquaflow.base.errors import AquaFlowError, first_line

if TYPE_CHECKING:
    from aquaflow.prior.runtime import Device
    from aquaflow.render.contract import Renderer

Figures = dict[str, float]
"""``first_call_s``, ``next_call_ms`` and differences, by name."""

LIMIT_S = 3600.0
"""An attempt that takes longer is stopped; gsplat's kernels take tens of minutes to compile on a
small board, TensorRT's engines minutes."""
SOFTWARE = "software"
"""Figure of an adapter: 1 of a program, 0 of a GPU."""
NO_KERNEL = "no kernel image"
"""How CUDA words kernels that were compiled for other GPUs."""


@dataclass(frozen=True)
class Attempt:
    """What came of an attempt."""

    figures: Figures = field(default_factory=dict)
    failed: str = ""
    """Why, in one sentence; empty if it did not."""
    adapters: tuple[str, ...] = ()
    """Those that wgpu finds, the one that was tried first; of other attempts none."""


def apart(name: str, command: tuple[str, ...] = (), limit_s: float = LIMIT_S) -> Attempt:
    """Try ``name`` in a process of its own."""
    program = command or (sys.executable, "-m", "aquaflow.doctor.attempts", name)
    try:
        ran = subprocess.run(program, capture_output=True, text=True, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired:
        return Attempt(failed=f"it did not end within {limit_s / 60.0:.0f} minutes")
    if ran.returncode != 0:
        said = (ran.stderr.strip().splitlines() or ["it said nothing"])[-1]
        return Attempt(failed=f"it crashed ({_ending(ran.returncode)}): {said}")
    said = json.loads(ran.stdout.strip().splitlines()[-1])
    return Attempt(**{**said, "adapters": tuple(said.get("adapters", ()))})


def _ending(status: int) -> str:
    return f"status {status}" if status > 0 else signal.Signals(-status).name


def draw(make: Callable[[], Renderer] | None = None) -> Figures:
    """Draw a known scene and its gradients, and compare both with the float64 reference.

    Raises:
        AquaFlowError: the renderer, gsplat's if ``make`` gives no other, does not draw, or draws
            something else.
    """
    from aquaflow.render.example_scene import SMALL, height_field
    from aquaflow.render.gsplat import GsplatRenderer
    from aquaflow.render.reference import PICTURE, differences, drawn_and_differentiated, too_far

    scene, times = height_field(SMALL), [time.perf_counter()]
    renderer = (make or GsplatRenderer)()
    _check_torch(renderer)
    try:
        for _ in range(2):
            drawn_and_differentiated(renderer, scene)
            times.append(time.perf_counter())
        found = differences(renderer, scene)
    except RuntimeError as error:  # torch's for everything that a GPU cannot do
        raise AquaFlowError(_failure("gsplat", error)) from error
    if (reason := too_far(found)) is not None:
        name = renderer.name
        raise AquaFlowError(f"{name} draws wrongly here: {reason}; set mapping.renderer: cpu")
    picture = found.pop(PICTURE)
    return {
        **_durations(*times),
        "difference_picture": picture,
        "difference_gradients": max(found.values()),
    }


def draw_on_adapter() -> Figures:
    """The same by wgpu, and whether its adapter is a program that stands in for a GPU (SOFTWARE).

    Raises:
        AquaFlowError: as :func:`draw`; or the adapter failed, and the processor drew.
    """
    from aquaflow.render.webgpu import WgpuRenderer

    renderer = WgpuRenderer()
    figures = draw(lambda: renderer)
    if (reason := renderer.failed) is not None:
        raise AquaFlowError(f"{reason}; update its driver, or set mapping.renderer: cpu")
    return {**figures, SOFTWARE: float(renderer.is_software)}


def _adapters() -> tuple[str, ...]:
    from aquaflow.render.webgpu_device import find_adapters

    return tuple(str(adapter) for adapter, _ in find_adapters())


def _check_torch(renderer: Renderer) -> None:
    """Raise AquaFlowError where not even torch's own kernels run."""
    import torch

    try:
        torch.zeros(1, device=renderer.device).add(1.0).cpu()
    except RuntimeError as error:
        raise AquaFlowError(_failure("torch", error)) from error


def _failure(what: str, error: RuntimeError) -> str:
    """One sentence on a failure of ``what``, torch or gsplat."""
    from aquaflow.render.gsplat import Gpu, gpu_here

    gpu = gpu_here()
    if NO_KERNEL not in str(error) or not isinstance(gpu, Gpu):
        return f"{what} fails on this GPU ({first_line(error)})"
    if what == "torch":
        return (
            f"torch {gpu.torch} has kernels for {', '.join(gpu.kernels)} and not for compute "
            f"capability {gpu.capability}; install a build that has them"
        )
    return (
        f"gsplat's kernels were not compiled for compute capability {gpu.capability}; compile them "
        f"with TORCH_CUDA_ARCH_LIST={gpu.capability}"
    )


def infer(device: Device) -> Figures:
    """Run the prior that is shipped, and compare what tracking gets with what the CPU says.

    Raises:
        AquaFlowError: it does not run there, runs elsewhere, or says something else.
    """
    from aquaflow.prior.describe import check, differences, example_picture
    from aquaflow.prior.describers import describer_in
    from aquaflow.prior.factory import SHIPPED
    from aquaflow.prior.folder import read_card
    from aquaflow.prior.runtime import RuntimeSettings

    settings, card = RuntimeSettings(device, "fp32"), read_card(SHIPPED)
    times = [time.perf_counter()]
    describer = describer_in(SHIPPED, settings)
    picture = describer.fit(example_picture(card.height, card.width))
    for _ in range(2):
        describer.features(picture)
        times.append(time.perf_counter())
    found = differences(SHIPPED, settings)
    check(card.name, found, settings)
    return {**_durations(*times), "difference": max(found.values())}


def _durations(began: float, first: float, second: float) -> Figures:
    """Of the first call, and of the one after it; from three times in seconds."""
    return {"first_call_s": first - began, "next_call_ms": 1e3 * (second - first)}


ATTEMPTS: dict[str, Callable[[], Figures]] = {
    "gsplat": draw,
    "wgpu": draw_on_adapter,
    "cuda": partial(infer, "cuda"),
    "tensorrt": partial(infer, "tensorrt"),
}
"""By the names that :func:`apart` takes."""


def main() -> None:
    """Answer one attempt."""
    with redirect_stdout(sys.stderr):
        try:
            name = sys.argv[1]
            outcome = Attempt(ATTEMPTS[name](), adapters=_adapters() if name == "wgpu" else ())
        except AquaFlowError as error:
            outcome = Attempt(failed=str(error))
    print(json.dumps(asdict(outcome)))


if __name__ == "__main__":
    main()
