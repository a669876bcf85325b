"""The CUDA renderer: gsplat >= 1.5 behind the same contract."""

from __future__ import annotations

import re
import sys
from contextlib import redirect_stdout
from importlib import metadata

import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError
from aquaflow.render.activity import active_pixels, touches_active
from aquaflow.render.contract import (
    DILATION_PX2,
    NEAR_PLANE_M,
    TILE_PX,
    Rendering,
    check_devices,
    check_inputs,
    tile_grid,
)

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
        with redirect_stdout(sys.stderr):  # it tells there that it compiles, and --json is for us
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
    """Draws a map that lives on the CUDA device, with gsplat's four steps and their backward.

    Colours, range and alpha come from one pass. Tiles that are not active are neither sorted for
    nor drawn nor differentiated.

    Two differences to the contract, both within one grey level: gsplat stops before the Gaussian
    that would take the transmittance below 1e-4, and clamps alpha at 0.999. ``radius_px`` is
    gsplat's rounded extent.
    """

    name = "gsplat"
    isa = "cuda"
    threads = 1
    device = torch.device("cuda")

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
        check_inputs(means, quats, scales, opacities, colours, viewmat, K, width, height, active)
        given = (means, quats, scales, opacities, colours, viewmat, K.detach())
        check_devices(self.device, *given, active)
        *gaussians, view, intrinsics = (tensor.to(torch.float32) for tensor in given)
        sound = _sound(*gaussians) & torch.isfinite(view).all()
        kept = torch.nonzero(sound)[:, 0]
        visible = torch.zeros_like(sound)
        radius_px = torch.zeros_like(gaussians[0][:, 0].detach())
        if len(kept) == 0:  # gsplat does not take empty scenes
            image = gaussians[4].new_zeros(height, width, colours.shape[1])
            return Rendering(image, image[..., 0].clone(), visible, radius_px)
        chosen = [tensor[kept] for tensor in gaussians]
        image, alpha, extent = _rasterise(chosen, view, intrinsics, width, height, active)
        radius_px[kept] = extent.amax(1)
        return Rendering(image, alpha, radius_px > 0, radius_px)


def _rasterise(
    gaussians: list[Tensor],  # means [M, 3], quats [M, 4], scales [M, 3], opacities [M], colours
    view: Tensor,  # [4, 4] world -> camera
    intrinsics: Tensor,  # [3, 3] px
    width: int,
    height: int,
    active: Tensor | None,  # [rows, columns] bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Image [H, W, C], alpha [H, W] and half sizes [M, 2] px, 0 for what is not seen."""
    import gsplat

    means, quats, scales, opacities, colours = gaussians
    rows, columns = tile_grid(width, height)
    radii, centres, depths, conics, _ = gsplat.fully_fused_projection(
        means, None, quats, scales, view[None], intrinsics[None], width, height,
        eps2d=DILATION_PX2, near_plane=NEAR_PLANE_M, packed=False, opacities=opacities,
    )  # fmt: skip
    extent = radii[0].detach().float()
    if active is not None:
        box = (centres[0].detach() - extent, centres[0].detach() + extent)
        touching = touches_active(*box, active, width, height)[:, None]
        extent, radii = extent * touching, radii * touching
    _, tile_ids, order = gsplat.isect_tiles(
        centres, radii, depths, TILE_PX, columns, rows, packed=False
    )
    offsets = gsplat.isect_offset_encode(tile_ids, 1, columns, rows).reshape(1, rows, columns)
    image, alpha = gsplat.rasterize_to_pixels(
        centres, conics, colours[None], opacities[None], width, height, TILE_PX, offsets, order,
        masks=None if active is None else active[None], packed=False,
    )  # fmt: skip
    image, alpha = image[0], alpha[0, ..., 0]
    if active is not None:  # gsplat leaves the alpha of the other tiles as the memory was
        drawn = active_pixels(active, width, height)
        image = torch.where(drawn[..., None], image, 0.0)
        alpha = torch.where(drawn, alpha, 0.0)
    return image, alpha, extent


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
