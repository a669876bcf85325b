"""Where the map's data crosses between the host and the map's device, and how often.

Everything that a map is made of lives on one device, its renderer's: Gaussians, features, voxel
groups, medium, exposures, light, pictures, masks and ranges of its views, and the optimisers'
state. Nothing else in ``mapping`` moves a tensor between devices; each way in or out has its
function here, which counts what it moved under its own name. On the CPU, host and device are one:
nothing is moved, copied or counted.

Reading one number, as ``float(loss)`` does, is a decision and not counted here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from aquaflow.render.transfer_counts import COUNTS

Array = npt.NDArray[Any]
Module = TypeVar("Module", bound=nn.Module)


# --- in -------------------------------------------------------------------------------------------


def frame_in(
    pixels: Array,  # [H, W] or [H, W, 3] of a view
    device: torch.device,
) -> Tensor:
    """A view's picture or mask."""
    return _into("frame in", torch.from_numpy(pixels), device)


def pointmap_in(
    values: Tensor,  # [H, W] on the host
    device: torch.device,
) -> Tensor:
    """What tracking knows of every pixel's range."""
    return _into("pointmap in", values, device)


def pose_in(
    numbers: Array,  # [...] rotation, centre, view matrix or intrinsics
    device: torch.device,
) -> Tensor:
    """float32: where a camera is, and how it projects."""
    return _into("pose in", torch.from_numpy(numbers).to(torch.float32), device)


def insertion_in(
    values: Tensor,  # [...] on the host
    device: torch.device,
) -> Tensor:
    """What insertion computes on the host: draws of the seeded generator, start values."""
    return _into("insertion in", values, device)


def moves_in(
    values: Tensor,  # [...] on the host
    device: torch.device,
) -> Tensor:
    """The similarities by which keyframes have moved."""
    return _into("moves in", values, device)


def groups_in(
    numbers: Sequence[int],
    device: torch.device,
) -> Tensor:
    """[M] int64: voxel groups, whose dictionary is on the host."""
    return _into("groups in", torch.tensor(numbers, dtype=torch.int64), device)


def rows_in(
    numbers: Array,  # [M] int64
    device: torch.device,
) -> Tensor:
    """The Gaussians that a view of a finished map may show."""
    return _into("rows in", torch.from_numpy(numbers), device)


def water_in(
    values: Array | Sequence[float],  # [...]
    device: torch.device,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """What a fit of the water found: the medium, shading, exposures, the white balance."""
    host = torch.from_numpy(np.asarray(values)).to(dtype)
    return _into("water in", host, device)


def checkpoint_in(
    array: Array,  # [...] of any type
    device: torch.device,
) -> Tensor:
    """A tensor of a stored map; a copy."""
    return _into("checkpoint in", torch.from_numpy(np.array(array)), device)


def weights_in(module: Module, device: torch.device) -> Module:
    """A network as it is made, with all its parameters and buffers."""
    moved = module.to(device)
    if device.type != "cpu":
        COUNTS.add("weights in", sum(1 for _ in (*module.parameters(), *module.buffers())))
    return moved


# --- out ------------------------------------------------------------------------------------------


def picture_out(
    drawn: Tensor,  # [H, W] or [H, W, C]
) -> Array:
    """Something drawn: for the water's fit, insertion's filters, files and viewers."""
    return _out("picture out", drawn)


def pose_out(
    gradient: Tensor,  # [4, 4]
) -> Array:
    """The gradient of a view matrix; poses live on the host."""
    return _out("pose out", gradient)


def registration_out(
    sums: Tensor,  # [] or [6, 7]
) -> Array:
    """Sums over a held-out view's pixels; its pose is solved for on the host."""
    return _out("registration out", sums)


def insertion_out(
    chosen: Tensor,  # [M] or [M, ...] of the chosen pixels
) -> Array:
    """Pixels chosen for insertion, whose rays the camera model has on the host."""
    return _out("insertion out", chosen)


def groups_out(
    numbers: Tensor,  # [M] int64
) -> list[int]:
    """Voxels and sizes of groups."""
    listed: list[int] = _out("groups out", numbers).tolist()
    return listed


def water_out(
    values: Tensor,  # [...]
) -> Array:
    """float64: the medium and the exposures, for the next fit and for files."""
    return _out("water out", values).astype(np.float64)


def map_out(
    values: Tensor,  # [N, ...]
) -> Array:
    """Gaussians, for a PLY file or a viewer; a copy."""
    return _out("map out", values).copy()


def checkpoint_out(
    values: Tensor,  # [...] of any type
) -> Array:
    """A tensor of the map as it is to be stored; a copy."""
    return _out("checkpoint out", values).copy()


# --- both -----------------------------------------------------------------------------------------


def _into(
    name: str,
    host: Tensor,  # [...]
    device: torch.device,
) -> Tensor:
    if device.type == "cpu":
        return host
    # Without waiting for the device; memory that is not pinned is read before this returns.
    moved = host.to(device, non_blocking=True)
    COUNTS.add(name)
    return moved


def _out(
    name: str,
    tensor: Tensor,  # [...]
) -> Array:
    tensor = tensor.detach()
    if tensor.device.type != "cpu":
        tensor = tensor.cpu()
        COUNTS.add(name)
    return tensor.numpy()
