"""From the network to a prior folder: two ONNX files of one fixed picture size, and proof.

Encoder and decoder are separate files, because a keyframe is encoded once and decoded with many
frames. Parity with torch is measured on a random pair as the files come out.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from aquaflow.errors import AquaFlowError, InputError
from aquaflow.prior.folder import DECODER, ENCODER, PriorCard, sha256_of, write_card
from aquaflow.prior.mast3r.network import Mast3r, ViewGeometry
from aquaflow.prior.mast3r.settings import PATCH_PX, TINY
from aquaflow.prior.runtime import RuntimeSettings, Session

OPSET = 18
INLINE_BYTES = 1 << 30
"""Weights up to this lie in the ONNX file itself, larger ones beside it: a file ends at 2 GiB."""
OUTPUTS = tuple(f"{symbol}_{view}" for view in "ab" for symbol in ViewGeometry._fields)

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


class DecoderGraph(nn.Module):
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
    _write(encoder, (image,), ["image"], ["tokens"], folder / ENCODER)
    progress("export", 1, 3)
    tokens = encoder(image)
    # Two tensors: the exporter would make one input of the same tensor given twice.
    pair = (tokens, tokens.clone())
    _write(decoder, pair, ["tokens_a", "tokens_b"], OUTPUTS, folder / DECODER)
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
    found = Session(folder / ENCODER, settings)({"image": pair[0].numpy()})
    tokens = {"tokens_a": a.numpy(), "tokens_b": b.numpy()}
    found |= Session(folder / DECODER, settings)(tokens)
    return {name: relative_difference(expected[name].numpy(), found[name]) for name in expected}


def verify_tiny(folder: Path, progress: Progress) -> dict[str, float]:
    """Parity of a tiny network of the same code with random weights, exported to ``folder``."""
    torch.manual_seed(0)
    return export(Mast3r(TINY), folder, *TINY_PX, licence="none", progress=progress).parity


def relative_difference(expected: npt.NDArray[np.float32], found: npt.NDArray[np.float32]) -> float:
    """Largest difference, relative to the largest expected value."""
    scale = max(float(np.abs(expected).max()), float(np.finfo(np.float32).tiny))
    return float(np.abs(expected - found).max()) / scale


def _graphs(network: Mast3r, width: int, height: int) -> tuple[EncoderGraph, DecoderGraph]:
    network = network.eval()
    return EncoderGraph(network), DecoderGraph(network, height // PATCH_PX, width // PATCH_PX)


def _write(
    graph: nn.Module,
    example: tuple[Tensor, ...],
    inputs: Sequence[str],
    outputs: Sequence[str],
    path: Path,
) -> None:
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
        torch.onnx.export(
            graph,
            example,
            str(path),
            input_names=inputs,
            output_names=outputs,
            opset_version=OPSET,
            dynamo=True,
            external_data=size > INLINE_BYTES,
            verbose=False,
        )
