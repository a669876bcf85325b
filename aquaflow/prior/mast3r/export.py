"""From the network to a prior folder: two ONNX files of one fixed picture size, and proof.

Encoder and decoder are separate files, because a keyframe is encoded once and decoded with many
frames. Parity with torch is measured on a random pair as the files come out.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from aquaflow.base.errors import InputError
from aquaflow.prior.folder import DECODER, ENCODER, PriorCard, sha256_of, write_card
from aquaflow.prior.mast3r.network import Mast3r, ViewGeometry
from aquaflow.prior.mast3r.settings import PATCH_PX, TINY
from aquaflow.prior.onnx_file import OPSET, relative_difference, write_onnx
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
        """As OUTPUTS."""
        first, second = self.network.decode(a, b, self.rows, self.columns)
        return (*first, *second)


@torch.no_grad()
def export(
    network: Mast3r, folder: Path, width: int, height: int, licence: str, progress: Progress
) -> PriorCard:
    """Write the prior to ``folder`` for pictures of ``width`` x ``height`` px; returns its card.

    Raises:
        InputError: the sides are no multiples of 16 px, or ``folder`` is not empty.
    """
    if width % PATCH_PX or height % PATCH_PX or min(width, height) <= 0:
        raise InputError(f"{width} x {height} px is no size of tokens; use multiples of {PATCH_PX}")
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
