"""Addresses of tensors for the compiled kernels, which read whatever they are given."""

from __future__ import annotations

import torch
from torch import Tensor

from aquaflow.base.errors import AquaFlowError


def pointer(
    tensor: Tensor,  # [...] contiguous, on the CPU
    dtype: torch.dtype = torch.float32,
) -> int:
    """Address of a tensor; the caller keeps it alive during the call.

    Raises AquaFlowError for any other tensor than a contiguous one of ``dtype`` on the CPU: a
    kernel that reads a foreign address ends the process.
    """
    if tensor.device.type != "cpu":
        raise AquaFlowError(
            f"A CPU kernel was given a tensor on {tensor.device}; pass tensors on the CPU, or use "
            "the renderer of that device."
        )
    if tensor.dtype != dtype or tensor.layout != torch.strided or not tensor.is_contiguous():
        raise AquaFlowError(
            f"A CPU kernel was given a tensor of {tensor.dtype} with shape {tuple(tensor.shape)} "
            f"and strides {_strides(tensor)}; pass a contiguous one of {dtype}."
        )
    return tensor.data_ptr()


def _strides(
    tensor: Tensor,  # [...]
) -> tuple[int, ...] | str:
    return tuple(tensor.stride()) if tensor.layout == torch.strided else str(tensor.layout)
