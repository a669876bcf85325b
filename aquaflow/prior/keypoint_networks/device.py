"""Which processor a network of torch runs on."""

from __future__ import annotations

from aquaflow.base.errors import AquaFlowError


def torch_device(prior: str, asked: str) -> str:
    """``cpu`` or ``cuda``; ``auto`` is the GPU where torch has one.

    Raises:
        AquaFlowError: what is asked for cannot be had.
    """
    import torch

    if asked == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if asked == "cuda" and not torch.cuda.is_available():
        raise AquaFlowError(
            f"prior {prior} was asked to run on cuda, which this torch has not; set prior.device "
            "to cpu, or install torch with CUDA"
        )
    if asked == "tensorrt":
        raise AquaFlowError(
            f"prior {prior} runs in torch, which has no TensorRT; set prior.device to cpu or cuda"
        )
    return asked
