"""The kernels under address and undefined-behaviour sanitizers, on scenes that break renderers."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch

from aquaflow.render.native import build as native
from tests.render.kernel_driver import Task, compile_driver, run_driver
from tests.render.render_scenes import Scene, random_scene

pytestmark = pytest.mark.ci

CHECKS = "address,undefined,float-cast-overflow"
SANITIZE = ("-O1", "-g1", f"-fsanitize={CHECKS}", "-fno-sanitize-recover=all")
NAN, INF = float("nan"), float("inf")
OVERFLOWING = ("colours = 1e+19", "colours = 3e+38")
"""Numbers, but no numbers any more when multiplied with an image gradient."""


ISAS = [
    pytest.param(isa, marks=[pytest.mark.slow] if slower else [])
    for slower, isa in enumerate(native.supported_isas())
]


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The driver under sanitizers, compiled for the instruction set that is asked for."""
    compiler = native.find_compiler()
    if compiler is None:
        pytest.skip("no C++ compiler")
    folder = tmp_path_factory.mktemp("sanitized")
    probe = [*compiler, *SANITIZE, "-x", "c++", "-", "-o", str(folder / "probe")]
    if subprocess.run(probe, input=b"int main() {}", capture_output=True, check=False).returncode:
        pytest.skip(f"{compiler[0]} has no address and undefined-behaviour sanitizers")

    @cache
    def driver(isa: str) -> Path:
        built = compile_driver(compiler, isa, folder / isa, SANITIZE)
        assert built.returncode == 0, built.stderr
        return folder / isa

    return driver


def with_values(name: str, value: float, seed: int) -> Scene:
    """Every second Gaussian has ``value`` in all elements of one input."""
    scene = random_scene(seed)
    tensor = getattr(scene, name).clone()
    tensor[::2] = value
    return replace(scene, **{name: tensor})


def with_camera(element: tuple[int, int], value: float) -> Scene:
    scene = random_scene(20)
    scene.viewmat[element] = value
    return scene


def with_intrinsics(element: tuple[int, int], value: float) -> Scene:
    scene = random_scene(21)
    scene.K[element] = value
    return scene


def behind_camera() -> Scene:
    scene = random_scene(22)
    return replace(scene, means=scene.means - 10 * scene.viewmat[2, :3])


def around_camera_centre() -> Scene:
    """Gaussians on the camera's centre, and closer to it than the near plane on all sides."""
    scene = random_scene(23)
    centre = -scene.viewmat[:3, 3] @ scene.viewmat[:3, :3]
    offsets = torch.randn(scene.means.shape, generator=torch.Generator().manual_seed(0))
    offsets[::3] = 0
    return replace(scene, means=centre + 0.06 * offsets)


def identical(n: int) -> Scene:
    one = random_scene(24, n=1)
    parts = [getattr(one, name) for name in ("means", "quats", "scales", "opacities", "colours")]
    return Scene(*(part.repeat(n, *[1] * (part.dim() - 1)) for part in parts), one.viewmat, one.K)


def far_off_centre() -> Scene:
    """So near the edge of the view that the projection's ray is clamped, and huge."""
    scene = random_scene(25)
    return replace(scene, means=scene.means * 8, scales=scene.scales * 50)


def half_active(width: int, height: int) -> torch.Tensor:
    rows, columns = -(-height // 16), -(-width // 16)
    return torch.arange(rows * columns).view(rows, columns) % 2 == 0


def stress_tasks() -> dict[str, Task]:
    scenes = {
        **{f"N = {n}": random_scene(0, n=n) for n in (0, 1, 2, 63, 64, 65)},
        **{
            f"{name} = {value}": with_values(name, value, seed)
            for seed, name in enumerate(("means", "quats", "scales", "opacities", "colours"))
            for value in (NAN, INF, -INF, 0.0, -1.0, 1e-38, 1e-45, 1e4, 1e19, 3e38)
        },
        **{
            f"viewmat {element} = {value}": with_camera(element, value)
            for element in ((0, 0), (2, 2), (1, 3))
            for value in (NAN, INF, 0.0, 1e30)
        },
        **{
            f"K {element} = {value}": with_intrinsics(element, value)
            for element in ((0, 0), (0, 2))
            for value in (NAN, INF, 0.0, 1e-30, 1e30, -40.0)
        },
        "opacity 1": with_values("opacities", 1.0, 5),
        "behind the camera": behind_camera(),
        "around the camera's centre": around_camera_centre(),
        "all identical": identical(3000),
        "far off centre": far_off_centre(),
        "three channels": random_scene(26, channels=3),
    }
    sizes = {"1 x 1": (1, 1), "wide": (8192, 3), "tall": (3, 8192), "one tile": (16, 16)}
    tasks = {name: Task(scene) for name, scene in scenes.items()}
    tasks |= {
        f"{name}, {channels} channels": Task(random_scene(27, channels=channels), *size)
        for name, size in sizes.items()
        for channels in (3, 4)
    }
    tasks |= {
        f"{name}, half the tiles active": Task(random_scene(28), *size, active=half_active(*size))
        for name, size in {**sizes, "usual": (52, 39)}.items()
    }
    one = {f"{name}, one thread": replace(task, threads=1) for name, task in tasks.items()}
    return {**tasks, **one, "many threads": Task(random_scene(29), threads=9)}


@pytest.mark.parametrize("isa", ISAS)
def test_no_sanitizer_reports_on_the_stress_scenes(
    isa: str, sanitized: Callable[[str], Path], tmp_path: Path
) -> None:
    tasks = stress_tasks()
    results = run_driver([str(sanitized(isa))], tasks, tmp_path)
    for name, result in results.items():
        if name.startswith(OVERFLOWING):
            continue
        stepped, before = result.pop("stepped_means"), tasks[name].scene.means
        assert torch.equal(stepped.isfinite(), before.isfinite()), f"'{name}'"
        for key, tensor in result.items():
            assert tensor.isfinite().all(), f"{key} of '{name}'"


@pytest.mark.parametrize("isa", ISAS)
def test_no_sanitizer_reports_on_two_million_gaussians(
    isa: str, sanitized: Callable[[str], Path], tmp_path: Path
) -> None:
    scene = random_scene(30, n=2_000_000, channels=3, sigma_m=0.01)
    result = run_driver([str(sanitized(isa))], {"two million": Task(scene)}, tmp_path)
    assert result["two million"]["visible"].sum() > 1_000_000


@pytest.mark.parametrize("isa", ISAS)
def test_every_allocation_may_fail_and_the_next_call_succeeds(
    isa: str, sanitized: Callable[[str], Path], tmp_path: Path
) -> None:
    tasks = {"usual": Task(random_scene(31, n=500)), "small": Task(random_scene(32, n=1), 1, 1)}
    driver = [str(sanitized(isa))]
    plain = run_driver(driver, tasks, tmp_path)
    starved = run_driver(driver, tasks, tmp_path, "--out-of-memory")
    for name, result in plain.items():
        assert all(torch.equal(tensor, starved[name][key]) for key, tensor in result.items())
