"""Writing a network as ONNX, and saying how far what runs is from what was trained."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from aquaflow.base.errors import AquaFlowError

OPSET = 18
"""ONNX operator set of exported files."""
INLINE_BYTES = 1 << 30
"""Weights up to this lie in the ONNX file itself, larger ones in a file next to it: an ONNX file
ends at 2 GiB."""


def write_onnx(
    graph: nn.Module,
    example: tuple[Tensor, ...],  # [...] each, as the graph takes them
    inputs: Sequence[str],
    outputs: Sequence[str],
    path: Path,
    dynamic_shapes: tuple[Any, ...] | None = None,
) -> None:
    """Export ``graph`` as traced on ``example``; sizes are fixed unless ``dynamic_shapes`` names
    them.

    Raises:
        AquaFlowError: onnx or onnxscript is not installed.
    """
    try:
        import onnxscript  # noqa: F401  # the exporter's own message names no remedy
    except ImportError as error:
        raise AquaFlowError(
            "export needs onnx and onnxscript; pip install 'aquaflow[export]'"
        ) from error
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # its remarks on torchvision
    size = sum(tensor.numel() * tensor.element_size() for tensor in graph.state_dict().values())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's remarks on itself are of no use here
        try:
            torch.onnx.export(
                graph,
                example,
                str(path),
                input_names=inputs,
                output_names=outputs,
                opset_version=OPSET,
                dynamo=True,
                dynamic_shapes=dynamic_shapes,
                external_data=size > INLINE_BYTES,
                verbose=False,
            )
        except Exception as error:
            if _was_interrupted(error):
                raise KeyboardInterrupt from error
            raise


def _was_interrupted(error: BaseException) -> bool:
    """True for a Ctrl-C, which the exporter wraps into an error of its own."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause is not None


def relative_difference(
    expected: npt.NDArray[np.float32],  # [...]
    found: npt.NDArray[np.float32],  # [...] as expected
) -> float:
    """Largest difference, relative to the largest expected value."""
    scale = max(float(np.abs(expected).max()), float(np.finfo(np.float32).tiny))
    return float(np.abs(expected - found).max()) / scale
