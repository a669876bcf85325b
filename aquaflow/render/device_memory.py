"""The memory of the device that a map lives on: how much is left, and giving back what is idle.

torch keeps blocks that no tensor uses any more, and the driver counts them as taken; the next
tensors get them first. So what is left for a map is what the driver has, and those blocks. A new
tensor needs one block that is large enough: pieces in many blocks can be too small, and then giving
them back to the driver helps.
"""

from __future__ import annotations

import traceback

import torch


def usable_share(device: torch.device) -> float | None:
    """Of the device's memory, what new tensors may have, in [0, 1].

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
