"""Gaussians no optimiser should make: drawn or culled, but neither picture nor gradient breaks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.geometry.camera import CameraModel
from aquaflow.lab.stress.case import Check, case
from aquaflow.render import select_renderer
from aquaflow.render.contract import Renderer, Rendering
from aquaflow.render.cpu import TileRenderer

CAMERA = CameraModel(32, 24, 28.0, 28.0, 16.0, 12.0)
COUNT = 24
"""Small and few, so that a case is quick; every other Gaussian is spoiled."""


@dataclass
class RandomGaussians:
    """Renderer inputs, in the order of its arguments."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colours: Tensor

    def tensors(self) -> list[Tensor]:
        """Tensors in the order of the renderer's arguments."""
        return [self.means, self.quats, self.scales, self.opacities, self.colours]


def cloud(seed: int, count: int = COUNT) -> RandomGaussians:
    """Sound Gaussians 1 to 3 m before a camera at the origin."""
    rng = torch.Generator().manual_seed(seed)
    depth = 1.0 + 2.0 * torch.rand(count, 1, generator=rng)
    across = (torch.rand(count, 2, generator=rng) - 0.5) * torch.tensor([1.0, 0.7])
    return RandomGaussians(
        torch.cat([across, torch.ones(count, 1)], 1) * depth,
        torch.randn(count, 4, generator=rng),
        0.05 + 0.1 * torch.rand(count, 3, generator=rng),
        0.2 + 0.7 * torch.rand(count, generator=rng),
        torch.rand(count, 4, generator=rng),
    )


def _check_drawn(
    check: Check,
    gaussians: RandomGaussians,
    culled: Tensor | None = None,  # [N] bool
) -> None:
    """Both renderers: finite forward and backward, alpha in [0, 1], ``culled`` [N] without trace.

    The gradient is that of a plain sum over picture and alpha.
    """
    for renderer in (select_renderer("auto", 1), TileRenderer(1)):
        leaves = [tensor.clone().requires_grad_() for tensor in gaussians.tensors()]
        viewmat = torch.eye(4).requires_grad_()
        drawn = draw(renderer, [*leaves, viewmat])
        check.finite(f"picture of {renderer.name}", drawn.image, drawn.alpha, drawn.radius_px)
        if drawn.alpha.numel():
            check.below("alpha", float(drawn.alpha.detach().max()), 1.0 + 1e-5)
        (drawn.image.sum() + drawn.alpha.sum()).backward()  # type: ignore[no-untyped-call]
        for leaf in [*leaves, viewmat]:
            check.finite(f"gradient of {renderer.name}", leaf.grad)
        if culled is not None:
            check.true(f"{renderer.name} culls", not bool(drawn.visible[culled].any()))
            still = [leaf.grad is None or not bool(leaf.grad[culled].any()) for leaf in leaves]
            check.true(f"{renderer.name} gives no gradient to what it culls", all(still))


def draw(
    renderer: Renderer,
    inputs: list[Tensor],  # five of [N, ...], then [4, 4]
) -> Rendering:
    """The picture of a cloud's five tensors, from the view matrix that follows them."""
    means, quats, scales, opacities, colours, viewmat = inputs
    K = torch.from_numpy(CAMERA.K).to(torch.float32)
    size = (CAMERA.width, CAMERA.height)
    return renderer(means, quats, scales, opacities, colours, viewmat, K, *size)


def _half() -> Tensor:
    """[COUNT] bool: every other Gaussian is spoiled."""
    return torch.arange(COUNT) % 2 == 0


def _spoil(seed: int, change: Callable[[RandomGaussians, Tensor], None]) -> RandomGaussians:
    gaussians = cloud(seed)
    change(gaussians, _half())
    return gaussians


@case("gaussians", "render.reference.find_sound")
def zero_scales(check: Check, seed: int) -> None:
    """A scale of exactly zero."""
    _check_drawn(check, _spoil(seed, lambda g, i: g.scales.__setitem__(i, 0.0)), _half())


@case("gaussians", "render.reference.DILATION_PX2")
def tiny_scales(check: Check, seed: int) -> None:
    """Scales whose squares underflow: the low-pass filter keeps the footprint's determinant."""
    _check_drawn(check, _spoil(seed, lambda g, i: g.scales.__setitem__(i, 1e-25)))


@case("gaussians", "render.reference.MAX_SIGMA_PX")
def huge_scales(check: Check, seed: int) -> None:
    """Scales of 100 km and more, whose determinants leave float32."""

    def change(g: RandomGaussians, i: Tensor) -> None:
        g.scales[i] = 1e12
        g.scales[2] = 1e5

    _check_drawn(check, _spoil(seed, change), _half())


@case("gaussians", "render.reference.MIN_QUAT_NORM_SQ")
def zero_and_denormal_quaternions(check: Check, seed: int) -> None:
    """Quaternions without a direction."""

    def change(g: RandomGaussians, i: Tensor) -> None:
        g.quats[i] = 0.0
        g.quats[0], g.quats[2] = 1e-40, 1e-13

    _check_drawn(check, _spoil(seed, change), _half())


@case("gaussians", "render.reference.MAX_ALPHA")
def opacity_0_and_1(check: Check, seed: int) -> None:
    """Fully opaque ones before others, and ones that are not there."""

    def change(g: RandomGaussians, i: Tensor) -> None:
        g.opacities[:] = 1.0
        g.opacities[i] = 0.0

    _check_drawn(check, _spoil(seed, change), _half())


@case("gaussians", "render.reference.NEAR_PLANE_M")
def behind_the_camera(check: Check, seed: int) -> None:
    """Behind the camera and mirrored into the picture if it is not checked."""
    _check_drawn(check, _spoil(seed, lambda g, i: g.means.__setitem__(i, -g.means[i])), _half())


@case("gaussians", "render.reference.NEAR_PLANE_M")
def on_the_camera_centre(check: Check, seed: int) -> None:
    """At range zero, where the projection divides by zero, and a centimetre away."""

    def change(g: RandomGaussians, i: Tensor) -> None:
        g.means[i] = 0.0
        g.means[2, 2] = 0.01

    _check_drawn(check, _spoil(seed, change), _half())


@case("gaussians", "render.reference.find_sound")
def not_finite(check: Check, seed: int) -> None:
    """NaN and infinity in every input."""

    def change(g: RandomGaussians, i: Tensor) -> None:
        bad = (float("nan"), float("inf"), float("-inf"))
        for n, row in enumerate(torch.nonzero(i)[:, 0].tolist()):
            g.tensors()[n % 5][row] = bad[n % 3]

    _check_drawn(check, _spoil(seed, change), _half())


@case("gaussians", "render.contract.check_inputs")
def no_gaussian(check: Check, seed: int) -> None:
    """An empty map."""
    _check_drawn(check, cloud(seed, 0))


@case("gaussians", "render.contract.check_inputs")
def one_gaussian(check: Check, seed: int) -> None:
    """A map of one."""
    _check_drawn(check, cloud(seed, 1))


@case("gaussians", "render.reference.MIN_TRANSMITTANCE")
def all_identical(check: Check, seed: int) -> None:
    """Every Gaussian in the same place: their order is undefined, transmittance reaches 0."""
    first = cloud(seed, 1)
    copies = (tensor.repeat(500, *[1] * (tensor.dim() - 1)) for tensor in first.tensors())
    _check_drawn(check, RandomGaussians(*copies))


@case("gaussians", "render.cpu.CpuRenderer", long=True)
def one_million(check: Check, seed: int) -> None:
    """10^6 Gaussians on the renderer of this machine, forward and backward."""
    renderer: Renderer = select_renderer("auto", None)
    leaves = [tensor.requires_grad_() for tensor in cloud(seed, 1_000_000).tensors()]
    drawn = draw(renderer, [*leaves, torch.eye(4)])
    check.finite("picture", drawn.image, drawn.alpha)
    (drawn.image.sum() + drawn.alpha.sum()).backward()  # type: ignore[no-untyped-call]
    for leaf in leaves:
        check.finite("gradient", leaf.grad)
