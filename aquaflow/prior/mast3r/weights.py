"""Loading the public checkpoint, which the user brings, into our network.

The file is read without running any code in it (``weights_only``): its ``args`` entry, an
``argparse.Namespace``, is the one other type allowed, and is ignored.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aquaflow.base.errors import InputError, reason_of
from aquaflow.prior.mast3r.network import Mast3r
from aquaflow.prior.mast3r.settings import FULL, Mast3rSize

LICENCE_NOTICE = (
    "The public MASt3R weights are under CC BY-NC-SA 4.0 and the terms of their training data: "
    "not for commercial use. What is exported from them is under the same terms."
)
"""Shown by whatever reads the weights, and kept in the card of what is exported."""

NAMED = 3
"""Tensors that an error names; the rest is counted."""


def load_checkpoint(path: Path, size: Mast3rSize = FULL) -> Mast3r:
    """The network with the weights of ``path``, in evaluation mode, on the CPU.

    Raises:
        InputError: there is no such file, it holds anything but tensors, or tensors are missing,
            left over or of another shape.
    """
    state = _tensors_of(path)
    with torch.device("meta"):
        network = Mast3r(size)
    expected = network.state_dict()
    problems = [f"{name} is missing" for name in expected if name not in state]
    problems += [f"{name} is unknown" for name in state if name not in expected]
    problems += [
        f"{name} is {tuple(state[name].shape)}, not {tuple(tensor.shape)}"
        for name, tensor in expected.items()
        if name in state and state[name].shape != tensor.shape
    ]
    if problems:
        more = f" and {len(problems) - NAMED} more" if len(problems) > NAMED else ""
        raise InputError(
            f"{path} is not the checkpoint of this network: {', '.join(problems[:NAMED])}{more}; "
            "give the metric ViT-L / BaseDecoder / catmlp+dpt checkpoint"
        )
    network.load_state_dict(state, strict=True, assign=True)
    return network.float().eval().requires_grad_(False)


def _tensors_of(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise InputError(f"there is no checkpoint at {path}; give the downloaded .pth file")
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler lets through whatever damaged bytes make it do
        raise InputError(
            f"{path} cannot be read as a checkpoint of tensors ({reason_of(error)}); "
            "download it again"
        ) from error
    state = content.get("model", content) if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(x, Tensor) for x in state.values()):
        raise InputError(f"{path} holds no tensors by name; give the downloaded .pth file")
    return state
