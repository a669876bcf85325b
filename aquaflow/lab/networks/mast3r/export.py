"""From the network to a prior folder: two ONNX files of one fixed picture size, and proof.

Encoder and decoder are separate files, because a keyframe is encoded once and decoded with many
frames. Parity with torch is measured on a random pair as the files come out.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from aquaflow.base.errors import ArgumentError, InputError, reason_of
from aquaflow.lab.networks.mast3r.network import (
    FULL,
    PATCH_PX,
    TINY,
    Mast3r,
    Mast3rSize,
    ViewGeometry,
)
from aquaflow.lab.networks.onnx_file import OPSET, relative_difference, write_onnx
from aquaflow.prior.folder import DECODER, ENCODER, PriorCard, sha256_of, write_card
from aquaflow.prior.runtime import NetworkSession, RuntimeSettings

OUTPUTS = tuple(f"{symbol}_{view}" for view in "ab" for symbol in ViewGeometry._fields)
"""Outputs of the decoder, of each view."""

TINY_PX = (48, 32)
"""Width and height that the tiny network is verified at."""

Progress = Callable[[str, int, int], None]


class EncoderGraph(nn.Module):
    """``Mast3r.encode`` as a module of its own."""

    def __init__(self, network: Mast3r) -> None:
        super().__init__()
        self.network = network

    def forward(
        self,
        image: Tensor,  # [1, 3, H, W] RGB in [0, 1]
    ) -> Tensor:
        """[1, N, D]"""
        return self.network.encode(image)


class Mast3rDecoderGraph(nn.Module):
    """``Mast3r.decode`` at one picture size, its outputs side by side."""

    def __init__(self, network: Mast3r, rows: int, columns: int) -> None:
        super().__init__()
        self.network, self.rows, self.columns = network, rows, columns

    def forward(
        self,
        a: Tensor,  # [1, N, D]
        b: Tensor,  # [1, N, D]
    ) -> tuple[Tensor, ...]:
        """The outputs, as OUTPUTS names them."""
        first, second = self.network.decode(a, b, self.rows, self.columns)
        return (*first, *second)


@torch.no_grad()
def export(
    network: Mast3r, folder: Path, width: int, height: int, licence: str, progress: Progress
) -> PriorCard:
    """Write the prior to ``folder`` for pictures of ``width`` x ``height`` px; returns its card.

    Raises:
        ArgumentError: the sides are no multiples of 16 px.
        InputError: ``folder`` is not empty.
    """
    if width % PATCH_PX or height % PATCH_PX or min(width, height) <= 0:
        raise ArgumentError(
            f"{width} x {height} px is no size of tokens; use multiples of {PATCH_PX}"
        )
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise InputError(f"{folder} is not empty; give a new folder")
    encoder, decoder = _graphs(network, width, height)
    image = torch.zeros(1, 3, height, width)
    progress("export", 0, 3)
    write_onnx(encoder, (image,), ["image"], ["tokens"], folder / ENCODER)
    progress("export", 1, 3)
    tokens = encoder(image)
    # Two tensors: the exporter would make one input of the same tensor given twice.
    pair = (tokens, tokens.clone())
    write_onnx(decoder, pair, ["tokens_a", "tokens_b"], OUTPUTS, folder / DECODER)
    progress("export", 2, 3)
    files = {path.name: sha256_of(path) for path in sorted(folder.iterdir())}
    card = PriorCard(
        name="mast3r",
        width=width,
        height=height,
        descriptor=network.size.descriptor,
        metric=True,
        licence=licence,
        opset=OPSET,
        files=files,
        parity=parity_of(network, folder, width, height),
    )
    write_card(folder, card)
    progress("export", 3, 3)
    return card


@torch.no_grad()
def parity_of(network: Mast3r, folder: Path, width: int, height: int) -> dict[str, float]:
    """Largest relative difference between torch and ONNX of each output, for a random pair."""
    encoder, decoder = _graphs(network, width, height)
    pair = torch.rand(2, 1, 3, height, width, generator=torch.Generator().manual_seed(0))
    a, b = (encoder(image) for image in pair)
    expected = {"tokens": a} | dict(zip(OUTPUTS, decoder(a, b), strict=True))
    settings = RuntimeSettings(device="cpu")
    found = NetworkSession(folder / ENCODER, settings)({"image": pair[0].numpy()})
    tokens = {"tokens_a": a.numpy(), "tokens_b": b.numpy()}
    found |= NetworkSession(folder / DECODER, settings)(tokens)
    return {name: relative_difference(expected[name].numpy(), found[name]) for name in expected}


def verify_tiny(folder: Path, progress: Progress) -> dict[str, float]:
    """Parity of a tiny network of the same code with random weights, exported to ``folder``."""
    torch.manual_seed(0)
    return export(Mast3r(TINY), folder, *TINY_PX, licence="none", progress=progress).parity


def _graphs(network: Mast3r, width: int, height: int) -> tuple[EncoderGraph, Mast3rDecoderGraph]:
    network = network.eval()
    return EncoderGraph(network), Mast3rDecoderGraph(network, height // PATCH_PX, width // PATCH_PX)


# --------------------------------------------------------------------------------------------------
# Loading the public checkpoint, which the user brings, into our network.
#
# The file is read without running any code in it (``weights_only``): its ``args`` entry, an
# ``argparse.Namespace``, is the one other type allowed, and is ignored.

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
