"""The CUDA renderer: gsplat >= 1.5 behind the same contract."""

from __future__ import annotations

import re
import sys
import traceback
import warnings
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import metadata

import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError, first_line
from aquaflow.render.contract import (
    Rendering,
    active_pixels,
    check_devices,
    check_inputs,
    tile_grid,
    touches_active,
)
from aquaflow.render.limits import DILATION_PX2, NEAR_PLANE_M, TILE_PX

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


# --------------------------------------------------------------------------------------------------
# The GPU that torch sees, by its name, or why torch sees none.


@dataclass(frozen=True)
class Gpu:
    """What a report says of a GPU, and of the torch that reaches it."""

    name: str
    capability: str
    """Compute capability, as in 8.7."""
    memory_gb: float
    torch: str
    cuda: str
    """Versions of torch, and of the CUDA that it was built with."""
    kernels: tuple[str, ...]
    """What torch's own kernels were compiled for, as in sm_87."""

    def __str__(self) -> str:
        """All of it in one line."""
        return (
            f"{self.name}, compute capability {self.capability}, {self.memory_gb:.1f} GB, "
            f"torch {self.torch} with CUDA {self.cuda}"
        )


def gpu_here() -> Gpu | str:
    """The first GPU, or half a sentence on why torch sees none."""
    if torch.version.cuda is None:
        return f"torch {torch.__version__} is a build for the processor"
    with warnings.catch_warnings(record=True) as said:  # torch warns of a driver that is too old
        warnings.simplefilter("always")
        available = torch.cuda.is_available()
    if not available:
        cause = f" ({first_line(said[-1].message)})" if said else ""  # type: ignore[arg-type]
        return f"torch {torch.__version__} with CUDA {torch.version.cuda} sees no GPU{cause}"
    properties = torch.cuda.get_device_properties(0)
    return Gpu(
        properties.name,
        f"{properties.major}.{properties.minor}",
        properties.total_memory / 1e9,
        torch.__version__,
        torch.version.cuda,
        tuple(torch.cuda.get_arch_list()),
    )


# --------------------------------------------------------------------------------------------------
# The memory of the device that a map lives on: how much is left, and giving back what is idle.
#
# torch keeps blocks that no tensor uses any more, and the driver counts them as taken; the next
# tensors get them first. So what is left for a map is what the driver has, and those blocks. A new
# tensor needs one block that is large enough: pieces in many blocks can be too small, and then
# giving them back to the driver helps.


def usable_share(device: torch.device) -> float | None:
    """Share of the device's memory, what new tensors may have, in [0, 1].

    None on the CPU, for a device that is gone, and for a GPU without memory of its own (a
    Jetson's): there it is the machine's that runs short.
    """
    if device.type == "cpu":
        return None
    try:
        if torch.cuda.get_device_properties(device).is_integrated:
            return None
        free, total = torch.cuda.mem_get_info(device)
        idle = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    except RuntimeError:
        return None
    return (free + idle) / total if total else None


def give_back_idle(device: torch.device) -> None:
    """Let the driver have the blocks that no tensor uses; waits for the device."""
    if device.type != "cpu":
        torch.cuda.empty_cache()


def give_back_after(error: BaseException, device: torch.device) -> None:
    """The same once a tensor found no room: what was on the way to it is freed first.

    An exception holds the variables of all functions that it came through, and so their tensors.
    """
    if device.type != "cpu":
        cause: BaseException | None = error
        while cause is not None:
            traceback.clear_frames(cause.__traceback__)
            cause = cause.__context__
        give_back_idle(device)
