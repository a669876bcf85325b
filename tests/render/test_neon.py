"""The Arm kernels: cross-compiled, run under an emulator, compared with float64.

Needs the Debian packages g++-aarch64-linux-gnu and qemu-user (or qemu-user-static); on an Arm
machine the other tests do all this.
"""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch

from aquaflow.geometry.similarity import Sim3, Sim3Batch
from aquaflow.render.native import build as native
from aquaflow.render.photometric import photometric_loss_torch
from aquaflow.render.reference import ReferenceRenderer
from aquaflow.render.water import compose_water_torch
from aquaflow.tracking.adjustment.equations import AnchorMatches, equations_by_definition, project
from tests.render.kernel_driver import Task, compile_driver, run_driver
from tests.render.render_scenes import HEIGHT, NAMES, WIDTH, Scene, random_scene, relative_error

CROSS_COMPILER = "aarch64-linux-gnu-g++"
EMULATORS = ("qemu-aarch64", "qemu-aarch64-static")

SCENES = {
    "four channels": random_scene(40),
    "three channels": random_scene(41, channels=3),
    "many Gaussians": random_scene(42, n=1500),
    "large Gaussians": random_scene(43, sigma_m=0.8),
    "no Gaussian": random_scene(44, n=0),
}


@pytest.fixture(scope="module")
def on_arm(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, torch.Tensor]]:
    """What the NEON kernels make of the scenes."""
    emulator = next((name for name in EMULATORS if shutil.which(name)), None)
    for tool, there in ((CROSS_COMPILER, shutil.which(CROSS_COMPILER)), (EMULATORS[0], emulator)):
        if not there:
            pytest.skip(f"no {tool}: the Arm kernels are not run here")
    driver = tmp_path_factory.mktemp("neon") / "driver"
    built = compile_driver([CROSS_COMPILER], "neon", driver, ("-static",))  # no Arm libraries here
    assert built.returncode == 0, built.stderr
    tasks = {name: Task(scene) for name, scene in SCENES.items()}
    return run_driver([str(emulator), str(driver)], tasks, driver.parent)


def reference(scene: Scene, task: Task) -> tuple[torch.Tensor, torch.Tensor, list[torch.Tensor]]:
    """Image, alpha and gradients by the definition, in float64."""
    leaves = scene.leaves(torch.float64)
    out = ReferenceRenderer()(*leaves, WIDTH, HEIGHT)
    g_image, g_alpha = (torch.from_numpy(task.arrays[name]) for name in ("g_image", "g_alpha"))
    ((out.image * g_image).sum() + (out.alpha * g_alpha).sum()).backward()
    gradients = [leaf.grad if leaf.grad is not None else torch.zeros(0) for leaf in leaves[:6]]
    return out.image.detach(), out.alpha.detach(), gradients


@pytest.mark.parametrize("name", SCENES)
def test_neon_image_and_gradients_agree_with_the_float64_reference(
    name: str, on_arm: dict[str, dict[str, torch.Tensor]]
) -> None:
    got, scene = on_arm[name], SCENES[name]
    image, alpha, gradients = reference(scene, Task(scene))
    assert torch.allclose(got["image"].double(), image, rtol=0, atol=1e-4)
    assert torch.allclose(got["alpha"].double(), alpha, rtol=0, atol=1e-4)
    for key, expected in zip(NAMES, gradients, strict=True):
        if expected.any():
            assert relative_error(got[f"g_{key}"], expected) < 5e-5


@pytest.mark.parametrize("name", ["four channels", "three channels"])
def test_neon_loss_agrees_with_its_definition(
    name: str, on_arm: dict[str, dict[str, torch.Tensor]]
) -> None:
    got, arrays = on_arm[name], Task(SCENES[name]).arrays
    rendered = got["rendered"].double().requires_grad_()
    target, weight, mask = (
        torch.from_numpy(arrays[key]).double() for key in ("target", "weight", "mask")
    )
    loss = photometric_loss_torch(rendered, target, weight, mask, 0.2)
    loss.backward()
    assert rendered.grad is not None
    assert got["loss"].item() == pytest.approx(loss.item(), rel=1e-5)
    assert relative_error(got["g_rendered"], rendered.grad) < 1e-5


def test_neon_water_agrees_with_its_definition(
    on_arm: dict[str, dict[str, torch.Tensor]],
) -> None:
    got, arrays = on_arm["four channels"], Task(SCENES["four channels"]).arrays
    inputs = (got["image"], got["alpha"], torch.from_numpy(arrays["water"]))
    leaves = [tensor.double().requires_grad_() for tensor in inputs]
    uneven, gain = (torch.from_numpy(arrays[key]).double() for key in ("weight", "g_alpha"))
    image, z = compose_water_torch(*leaves, uneven, gain)
    g_image, g_z = (torch.from_numpy(arrays[key]).double() for key in ("target", "g_alpha"))
    wanted = torch.autograd.grad((image * g_image).sum() + (z * g_z).sum(), leaves)
    assert torch.allclose(got["rendered"].double(), image, atol=2e-6)
    for key, expected in zip(("g_drawn", "g_water_alpha", "g_water"), wanted, strict=True):
        assert relative_error(got[key], expected) < 1e-5


def test_neon_adam_makes_first_steps_of_the_learning_rate(
    on_arm: dict[str, dict[str, torch.Tensor]],
) -> None:
    got, before = on_arm["four channels"], SCENES["four channels"].means
    seen = got["visible"].bool()[:, None] & (got["g_means"].abs() > 1e-4)
    step = (got["stepped_means"] - before)[seen]
    assert seen.any()
    assert torch.allclose(step, -1e-3 * got["g_means"][seen].sign(), rtol=2e-3)
    assert torch.equal(got["stepped_means"][got["visible"] == 0], before[got["visible"] == 0])


def anchored(task: Task) -> tuple[AnchorMatches, Sim3Batch, np.ndarray]:
    """The anchor, poses and inverse depths that ``adjust`` of kernel_driver.cpp makes."""
    arrays = {key: task.arrays[key].reshape(-1, 3 if key == "target" else 1).astype(np.float64)
              for key in ("target", "weight", "mask")}  # fmt: skip
    points, index = task.width, np.arange(task.width)
    flat, seen = arrays["target"][:points, :2], arrays["mask"][:points, 0] > 0.5
    R = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    rho = 0.5 + arrays["weight"][:points, 0]
    matches = AnchorMatches(
        anchor=0,
        views=np.array([1, 2]),
        rays=np.column_stack([flat - 0.5, np.ones(points)]),
        rho=1.1 * rho,
        variance=np.where(index % 7 == 0, np.inf, 0.04),
        at=np.stack([flat - 0.4] * 2),
        used=np.stack([seen, seen & (index % 3 != 0)]),
        sigma=np.array([0.5, 0.25]),
    )
    steps = [Sim3(R, 0.1 * (1.0 + v + np.arange(3)), 1.0 + 0.1 * v) for v in range(2)]
    return matches, Sim3Batch.of([Sim3.identity(), *(T.inverse() for T in steps)]), rho


def test_neon_equations_of_an_adjustment_agree_with_their_definition(
    on_arm: dict[str, dict[str, torch.Tensor]],
) -> None:
    got = {key: value.double().numpy() for key, value in on_arm["four channels"].items()}
    matches, poses, rho = anchored(Task(SCENES["four channels"]))
    expected, scores = equations_by_definition(matches, poses, rho)
    errors = np.linalg.norm(project(matches, poses, rho).error, axis=-1)
    pairs = {"errors": errors, "scores": scores} | {
        name: getattr(expected, name) for name in ("H", "gradient", "gain", "offset")
    }
    for name, wanted in pairs.items():
        np.testing.assert_allclose(got[name], wanted, rtol=1e-4, atol=1e-5 * np.abs(wanted).max())


def test_a_cross_compiler_builds_the_variants_of_its_target() -> None:
    if not shutil.which(CROSS_COMPILER):
        pytest.skip(f"no {CROSS_COMPILER}: the Arm kernels are not built here")
    assert native.target_isas([CROSS_COMPILER]) == ("neon",)
