"""The CUDA renderer: gsplat >= 1.5 behind the same contract."""

from __future__ import annotations

import re
from importlib import metadata

import torch
from torch import Tensor

from aquaflow.errors import AquaFlowError
from aquaflow.render.activity import active_pixels, touches_active
from aquaflow.render.contract import DILATION_PX2, NEAR_PLANE_M, Rendering, check_inputs

OLDEST = (1, 5)
"""The first version with the features used here."""


def missing() -> str | None:
    """Why this machine cannot draw with gsplat and what to do, in one sentence; None: it can.

    The first call in a process may take minutes: where gsplat comes without kernels that fit torch,
    it compiles them when they are imported.
    """
    if not torch.cuda.is_available():
        return "Renderer gsplat needs a CUDA device and torch sees none; use renderer cpu."
    try:
        version = metadata.version("gsplat")
    except metadata.PackageNotFoundError:
        return "Renderer gsplat is not installed; run `pip install --no-deps 'gsplat>=1.5'`."
    if tuple(map(int, re.findall(r"\d+", version)[:2])) < OLDEST:
        return (
            f"gsplat {version} is too old for AquaFlow; "
            "run `pip install --no-deps --upgrade 'gsplat>=1.5'`."
        )
    return _missing_kernels()


def _missing_kernels() -> str | None:
    """gsplat without a compiler imports all the same, and fails at the first picture."""
    remedy = "install the CUDA toolkit (nvcc) that fits torch, or use renderer cpu."
    try:
        from gsplat.cuda._backend import _C
    except Exception as error:  # the import runs compilers and linkers
        cause = str(error).strip().partition("\n")[0] or type(error).__name__
        return f"gsplat's CUDA kernels do not load ({cause}); {remedy}"
    if _C is None:
        return f"gsplat has no CUDA kernels and cannot compile them; {remedy}"
    return None


def available() -> bool:
    """Whether this machine has a CUDA device, and gsplat with kernels for it."""
    return missing() is None


class GsplatRenderer:
    """Draws on the CUDA device; inputs are moved there, the result stays there.

    Two differences to the contract, both within one grey level: gsplat stops before the Gaussian
    that would take the transmittance below 1e-4, and clamps alpha at 0.999. ``radius_px`` is
    gsplat's rounded extent. An activity mask is laid over the
    finished picture and saves nothing: gsplat's public ``rasterization`` takes none.
    """

    name = "gsplat"
    isa = "cuda"
    threads = 1

    def __init__(self) -> None:
        """Raises AquaFlowError, saying what to do, when something is missing."""
        reason = missing()
        if reason is not None:
            raise AquaFlowError(reason)

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
        """Draw as the contract says."""
        from gsplat import rasterization

        check_inputs(means, quats, scales, opacities, colours, viewmat, K, width, height, active)
        inputs = (means, quats, scales, opacities, colours, viewmat, K.detach())
        on_device = [tensor.to(device="cuda", dtype=torch.float32) for tensor in inputs]
        *gaussians, view, intrinsics = on_device
        sound = _sound(*gaussians) & torch.isfinite(view).all()
        kept = torch.nonzero(sound)[:, 0]
        visible = torch.zeros(len(means), dtype=torch.bool, device="cuda")
        radius_px = torch.zeros(len(means), device="cuda")
        if len(kept) == 0:  # gsplat does not take empty scenes
            image = torch.zeros(height, width, colours.shape[1], device="cuda")
            return Rendering(image, image[..., 0].clone(), visible, radius_px)
        image, alpha, meta = rasterization(
            *(tensor[kept] for tensor in gaussians),
            view[None],
            intrinsics[None],
            width,
            height,
            near_plane=NEAR_PLANE_M,
            eps2d=DILATION_PX2,
            sh_degree=None,
            packed=False,
        )
        radii = meta["radii"][0].detach().float()  # [M] or, since 1.5, [M, 2]
        extent = radii[:, None].expand(-1, 2) if radii.dim() == 1 else radii
        image, alpha = image[0], alpha[0, ..., 0]
        if active is not None:
            active = active.to("cuda")
            centre = meta["means2d"][0].detach()
            box = (centre - extent, centre + extent)
            extent = extent * touches_active(*box, active, width, height)[:, None]
            pixels = active_pixels(active, width, height)
            image, alpha = image * pixels[..., None], alpha * pixels
        radius_px[kept] = extent.amax(1)
        return Rendering(image, alpha, radius_px > 0, radius_px)


def _sound(
    means: Tensor,  # [N, 3] m, world
    quats: Tensor,  # [N, 4] wxyz
    scales: Tensor,  # [N, 3] m
    opacities: Tensor,  # [N]
    colours: Tensor,  # [N, C]
) -> Tensor:
    """[N] bool: finite and not degenerate; gsplat itself does not look."""
    with torch.no_grad():
        finite = torch.isfinite(torch.cat([means, quats, scales, colours], 1)).all(1)
        positive = (scales > 0).all(1) & (opacities > 0) & torch.isfinite(opacities)
        return finite & positive & (quats.square().sum(1) > 0)
