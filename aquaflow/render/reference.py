"""The oracle: EWA splatting written densely in float64, one line per equation.

Symbols follow Zwicker et al., "EWA Volume Splatting" (2001), and Kerbl et al. 2023: a Gaussian has
covariance V; with W the rotation of the view and J the Jacobian of the projection, its footprint
has covariance V' = J W V W^T J^T (plus a low-pass filter) and conic Q = V'^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from aquaflow.render.contract import (
    CPU,
    Renderer,
    Rendering,
    active_pixels,
    check_devices,
    check_inputs,
    touches_active,
)
from aquaflow.render.example_scene import FARTHEST_M, NAMES, SplatScene
from aquaflow.render.limits import (
    DILATION_PX2,
    MAX_ALPHA,
    MAX_SIGMA_PX,
    MIN_ALPHA,
    MIN_QUAT_NORM_SQ,
    MIN_TRANSMITTANCE,
    NEAR_PLANE_M,
    RADIUS_SIGMAS,
    TANGENT_MARGIN,
)


@dataclass(frozen=True)
class Footprints:
    """The visible Gaussians on the image, nearest first."""

    index: Tensor  # [M] into the inputs
    centre: Tensor  # [M, 2] px
    conic: Tensor  # [M, 3] Q_xx, Q_xy, Q_yy, 1/px^2
    opacity: Tensor  # [M]
    extent: Tensor  # [M, 2] half size of the box where alpha reaches MIN_ALPHA, px
    radius_px: Tensor  # [M]

    def scatter(self, n: int) -> tuple[Tensor, Tensor]:
        """``visible`` [n] and ``radius_px`` [n] for all inputs."""
        visible = torch.zeros(n, dtype=torch.bool, device=self.index.device)
        visible[self.index] = True
        radius_px = torch.zeros(n, dtype=self.radius_px.dtype, device=self.index.device)
        radius_px[self.index] = self.radius_px
        return visible, radius_px


def rotation_matrices(
    quats: Tensor,  # [M, 4] wxyz, any positive length
) -> Tensor:
    """[M, 4] wxyz of any positive length -> [M, 3, 3]."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, 1).view(-1, 3, 3)


def find_sound(
    means: Tensor,  # [N, 3] m, world
    quats: Tensor,  # [N, 4] wxyz
    scales: Tensor,  # [N, 3] m
    opacities: Tensor,  # [N]
    colours: Tensor,  # [N, C]
    viewmat: Tensor,  # [4, 4] world -> camera
) -> Tensor:
    """Indices of the Gaussians that are finite, positive and in front of the camera."""
    with torch.no_grad():
        finite = torch.isfinite(torch.cat([means, quats, scales, colours], 1)).all(1)
        finite &= torch.isfinite(opacities)
        z = means @ viewmat[2, :3] + viewmat[2, 3]
        norm_sq = quats.square().sum(1)
        positive = (scales > 0).all(1) & (opacities > MIN_ALPHA) & (norm_sq > MIN_QUAT_NORM_SQ)
        if not torch.isfinite(viewmat).all():
            return torch.zeros(0, dtype=torch.long, device=means.device)
        return torch.nonzero(finite & positive & torch.isfinite(norm_sq) & (z > NEAR_PLANE_M))[:, 0]


def jacobian(
    t: Tensor,  # [M, 3] m, camera frame
    K: Tensor,  # [3, 3] px
    width: int,
    height: int,
) -> Tensor:
    """[M, 2, 3] of the projection at camera-frame means t, its ray clamped near the image."""
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    margin_x, margin_y = TANGENT_MARGIN * 0.5 * width / fx, TANGENT_MARGIN * 0.5 * height / fy
    z = t[:, 2]
    tan_x = (t[:, 0] / z).clamp(-cx / fx - margin_x, (width - cx) / fx + margin_x)
    tan_y = (t[:, 1] / z).clamp(-cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    rows = [fx / z, zero, -fx * tan_x / z, zero, fy / z, -fy * tan_y / z]
    return torch.stack(rows, 1).view(-1, 2, 3)


def footprints_of(
    index: Tensor,  # [M] sound Gaussians
    means: Tensor,  # [N, 3] m, world
    quats: Tensor,  # [N, 4] wxyz
    scales: Tensor,  # [N, 3] m
    opacities: Tensor,  # [N]
    viewmat: Tensor,  # [4, 4] world -> camera
    K: Tensor,  # [3, 3] px
    width: int,
    height: int,
) -> Footprints:
    """Footprints of the Gaussians ``index``, in that order."""
    opacity = opacities[index]
    W, d = viewmat[:3, :3], viewmat[:3, 3]
    t = means[index] @ W.T + d
    ES = rotation_matrices(quats[index]) * scales[index][:, None, :]
    M = jacobian(t, K, width, height) @ W @ ES
    V = M @ M.transpose(1, 2) + DILATION_PX2 * torch.eye(2, dtype=M.dtype, device=M.device)
    a, b, c = V[:, 0, 0], V[:, 0, 1], V[:, 1, 1]
    # det(V') by Cauchy-Binet: a c - b^2 cancels for needles
    normal = torch.linalg.cross(M[:, 0], M[:, 1])
    det = normal.square().sum(1) + DILATION_PX2 * (a + c - DILATION_PX2)
    conic = torch.stack([c / det, -b / det, a / det], 1)
    focal, centre = torch.stack([K[0, 0], K[1, 1]]), torch.stack([K[0, 2], K[1, 2]])
    centre_px = focal * t[:, :2] / t[:, 2:] + centre
    with torch.no_grad():
        reach = 2 * torch.log(opacity / MIN_ALPHA)  # squared Mahalanobis distance
        extent = (reach[:, None] * torch.stack([a, c], 1)).sqrt()
        largest = 0.5 * (a + c) + (0.25 * (a - c).square() + b.square()).sqrt()
        radius_px = RADIUS_SIGMAS * largest.sqrt()
    return Footprints(index, centre_px, conic, opacity, extent, radius_px)


def project(
    means: Tensor,  # [N, 3] m, world
    quats: Tensor,  # [N, 4] wxyz
    scales: Tensor,  # [N, 3] m
    opacities: Tensor,  # [N]
    colours: Tensor,  # [N, C]
    viewmat: Tensor,  # [4, 4] world -> camera
    K: Tensor,  # [3, 3] px
    width: int,
    height: int,
    active: Tensor | None = None,  # [ceil(H/16), ceil(W/16)] bool, tiles to draw
) -> Footprints:
    """Footprints of the visible Gaussians, nearest first, in the inputs' dtype.

    Computed twice: what is culled must not reach autograd, where zero times infinity is NaN.
    """
    inputs = (means, quats, scales, opacities, viewmat, K, width, height)
    with torch.no_grad():
        index = find_sound(means, quats, scales, opacities, colours, viewmat)
        draft = footprints_of(index, *inputs)
        low, high = draft.centre - draft.extent, draft.centre + draft.extent
        bounded = draft.radius_px < RADIUS_SIGMAS * MAX_SIGMA_PX
        inside = (high > 0).all(1) & (low[:, 0] < width) & (low[:, 1] < height)
        seen = inside & bounded
        if active is not None:
            seen &= touches_active(low, high, active, width, height)
        index = index[seen]
        z = means[index] @ viewmat[2, :3] + viewmat[2, 3]
        index = index[torch.argsort(z.float(), stable=True)]  # ties as in float32
    return footprints_of(index, *inputs)


def alpha_at(
    offset: Tensor,  # [..., P, 2] pixel centre minus footprint centre, px
    conic: Tensor,  # [..., 3]
    opacity: Tensor,  # [...]
) -> Tensor:
    """[..., P] alpha of Gaussians at pixels, clamped and thresholded."""
    dx, dy = offset.unbind(-1)
    qxx, qxy, qyy = conic[..., None, :].unbind(-1)
    power = -0.5 * (qxx * dx * dx + qyy * dy * dy) - qxy * dx * dy
    alpha = (opacity[..., None] * torch.exp(power)).clamp(max=MAX_ALPHA)
    return torch.where(alpha > MIN_ALPHA, alpha, torch.zeros_like(alpha))


def blend_weights(
    alpha: Tensor,  # [...] in [0, 1]
    dim: int,
) -> Tensor:
    """Weights of Gaussians that lie front to back along ``dim``."""
    edge = torch.zeros_like(alpha.narrow(dim, 0, min(1, alpha.shape[dim])))
    shifted = torch.cat([edge, alpha.narrow(dim, 0, max(0, alpha.shape[dim] - 1))], dim)
    transmittance = torch.cumprod(1 - shifted, dim)
    unsaturated = transmittance > MIN_TRANSMITTANCE
    return torch.where(unsaturated, alpha * transmittance, torch.zeros_like(alpha))


class ReferenceRenderer:
    """Every Gaussian at every pixel, in float64: exact, for small scenes only."""

    name = "reference"
    isa = "torch"
    threads = 1

    def __init__(self, device: torch.device = CPU) -> None:
        self.device = device

    def __call__(
        self,
        means: Tensor,  # [N, 3] m, world
        quats: Tensor,  # [N, 4] wxyz
        scales: Tensor,  # [N, 3] m
        opacities: Tensor,  # [N]
        colours: Tensor,  # [N, C]
        viewmat: Tensor,  # [4, 4] world -> camera
        K: Tensor,  # [3, 3] px
        width: int,
        height: int,
        active: Tensor | None = None,  # [ceil(H/16), ceil(W/16)] bool, tiles to draw
    ) -> Rendering:
        """Draw as the contract says; the result is float64."""
        check_inputs(means, quats, scales, opacities, colours, viewmat, K, width, height, active)
        check_devices(self.device, means, quats, scales, opacities, colours, viewmat, K, active)
        colours = colours.double()
        gaussians = (means.double(), quats.double(), scales.double(), opacities.double(), colours)
        camera = (viewmat.double(), K.detach().double())
        footprints = project(*gaussians, *camera, width, height, active)
        x = torch.arange(width, dtype=torch.float64, device=self.device) + 0.5
        y = torch.arange(height, dtype=torch.float64, device=self.device) + 0.5
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), 2).view(-1, 2)
        offset = pixels[None] - footprints.centre[:, None]
        alpha = alpha_at(offset, footprints.conic, footprints.opacity)
        weights = blend_weights(alpha, 0)
        if active is not None:
            weights = weights * active_pixels(active, width, height).reshape(-1)
        image = (weights.T @ colours[footprints.index]).view(height, width, -1)
        visible, radius_px = footprints.scatter(len(means))
        return Rendering(image, weights.sum(0).view(height, width), visible, radius_px)


# --------------------------------------------------------------------------------------------------
# How far a renderer's picture and gradients are from the float64 reference's.

PICTURE = "picture"
"""Key of the picture's difference; the gradients' are those of NAMES."""
MOST_PICTURE = 1.0 / 255.0
"""One grey level: what drops out of the picture below MIN_ALPHA may be one renderer's and not the
other's."""
MOST_GRADIENT = 0.05
"""Of float32 kernels with fast mathematics that stop one Gaussian earlier (see GsplatRenderer); a
wrong formula differs by tens of percent."""


def drawn_and_differentiated(
    renderer: Renderer, scene: SplatScene, dtype: torch.dtype = torch.float32
) -> list[Tensor]:
    """[H, W, 5] colours, range and alpha, then the gradients of NAMES, drawn from inputs of
    ``dtype``; float64 and on the CPU, wherever the renderer draws."""
    drawn, gradients = scene.differentiated_by(renderer, scene.leaves(renderer.device, dtype))
    picture = torch.cat([drawn.image, drawn.alpha[..., None]], 2).detach()
    return [tensor.cpu().double() for tensor in (picture, *gradients)]


def differences(renderer: Renderer, scene: SplatScene) -> dict[str, float]:
    """The picture's largest difference, in shares of the full scale of each channel and of alpha;
    for each input the relative L2 difference of its gradient."""
    found = drawn_and_differentiated(renderer, scene)
    exact = drawn_and_differentiated(ReferenceRenderer(), scene, torch.float64)
    full_scale = torch.tensor([1.0, 1.0, 1.0, FARTHEST_M, 1.0])
    picture = ((found[0] - exact[0]).abs() / full_scale).max()
    gradients = zip(NAMES, found[1:], exact[1:], strict=True)
    return {
        PICTURE: float(picture),
        **{name: float((got - wanted).norm() / wanted.norm()) for name, got, wanted in gradients},
    }


def too_far(found: dict[str, float]) -> str | None:
    """The first of ``found`` that is beyond its bound, in words; None: all agree.

    A difference that is no number is beyond every bound.
    """
    for name, difference in found.items():
        most = MOST_PICTURE if name == PICTURE else MOST_GRADIENT
        if not difference <= most:
            what = "its picture" if name == PICTURE else f"its gradient of {name}"
            return f"{what} is {difference:.1e} from the reference's, more than {most:.1e}"
    return None
