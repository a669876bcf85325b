"""A scene to try renderers on: a textured height field, seeded, in any size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.render.contract import CPU, Renderer, Rendering

CLOSEST_M, FARTHEST_M = 1.0, 5.0
"""Ranges at which a vehicle maps."""
DEPTH_NOISE = 0.01
"""Relative: a map's surface is not smooth."""
SIGMA_PX = (2.0, 4.0)
OPACITY = (0.5, 0.95)
"""Standard deviation on the picture, and opacity: evenly between these."""
FOCAL_WIDTHS = 0.8
"""Focal length in image widths: 64 degrees across, as an underwater housing leaves it."""
TURN_RAD = 0.3
"""Of the camera in the world: no matrix of the scene is the identity."""
NAMES = ("means", "quats", "scales", "opacities", "colours", "viewmat")
"""Inputs that renderers differentiate, in the order of the contract."""


@dataclass(frozen=True)
class Size:
    """Number of Gaussians, and the picture in pixels."""

    n: int
    width: int
    height: int

    @property
    def pixels(self) -> int:
        """Number of pixels of the picture."""
        return self.width * self.height

    @property
    def picture(self) -> str:
        """Width and height for the table."""
        return f"{self.width} x {self.height}"


SMALL = Size(400, 96, 72)
"""What the dense float64 reference can hold; gradients are compared here."""


@dataclass(frozen=True)
class SplatScene:
    """Gaussians, camera and the gradient that comes in from a loss; float32 on the CPU."""

    size: Size
    inputs: tuple[Tensor, ...]  # as NAMES
    K: Tensor  # [3, 3] px
    g_image: Tensor  # [H, W, 4]
    g_alpha: Tensor  # [H, W]

    def leaves(
        self, device: torch.device = CPU, dtype: torch.dtype = torch.float32
    ) -> list[Tensor]:
        """The inputs, each asking for its gradient."""
        moved = [tensor.detach().to(device=device, dtype=dtype) for tensor in self.inputs]
        return [tensor.requires_grad_() for tensor in moved]

    def drawn_by(
        self,
        renderer: Renderer,
        leaves: Sequence[Tensor],  # five of [N, ...], then [4, 4], as NAMES
    ) -> Rendering:
        """The picture, with ``leaves`` in place of the inputs."""
        means, quats, scales, opacities, colours, viewmat = leaves
        gaussians = (means, quats, scales, opacities, colours)
        K = self.K.to(viewmat.device)
        return renderer(*gaussians, viewmat, K, self.size.width, self.size.height)

    def differentiated_by(
        self,
        renderer: Renderer,
        leaves: Sequence[Tensor],  # five of [N, ...], then [4, 4], as NAMES, that ask for gradients
    ) -> tuple[Rendering, tuple[Tensor, ...]]:
        """The picture, and the gradients of ``leaves`` for the scene's gradient of a loss."""
        drawn = self.drawn_by(renderer, leaves)
        incoming = [g.to(drawn.image) for g in (self.g_image, self.g_alpha)]
        return drawn, torch.autograd.grad([drawn.image, drawn.alpha], leaves, incoming)


def height_field(size: Size, seed: int = 0) -> SplatScene:
    """Gaussians all over the picture, 1 to 5 m away, as wide on the image as a map's."""
    rng = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=rng)

    n, focal = size.n, FOCAL_WIDTHS * size.width
    x, y = uniform(0.0, 1.0, n), uniform(0.0, 1.0, n)  # shares of the picture
    middle, half = (CLOSEST_M + FARTHEST_M) / 2.0, (FARTHEST_M - CLOSEST_M) / 2.0
    relief = middle + half * torch.sin(7.0 * x + 1.0) * torch.cos(5.0 * y)
    depth = relief * (1.0 + DEPTH_NOISE * torch.randn(n, generator=rng))
    rays = torch.stack(
        [(x - 0.5) * size.width / focal, (y - 0.5) * size.height / focal, torch.ones(n)], 1
    )
    viewmat = _view()
    means = (rays * depth[:, None] - viewmat[:3, 3]) @ viewmat[:3, :3]
    texture = 0.5 + 0.4 * torch.sin(torch.stack([40.0 * x, 40.0 * y, 30.0 * (x + y)], 1))
    inputs = (
        means,
        torch.randn(n, 4, generator=rng),
        uniform(*SIGMA_PX, n, 3) * (depth / focal)[:, None],
        uniform(*OPACITY, n),
        torch.cat([texture, depth[:, None]], 1),  # colour and range, as the mapper draws
        viewmat,
    )
    K = torch.tensor(
        [[focal, 0.0, size.width / 2.0], [0.0, focal, size.height / 2.0], [0.0, 0.0, 1.0]]
    )
    g_image = torch.randn(size.height, size.width, 4, generator=rng)
    return SplatScene(size, inputs, K, g_image, torch.randn(g_image.shape[:2], generator=rng))


def _view() -> Tensor:
    """[4, 4] world -> camera."""
    view = torch.eye(4)
    cosine, sine = math.cos(TURN_RAD), math.sin(TURN_RAD)
    view[:3, :3] = torch.tensor([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    view[:3, 3] = torch.tensor([0.2, -0.1, 0.3])
    return view
