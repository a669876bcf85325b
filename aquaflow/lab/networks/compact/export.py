"""From trained weights to the prior folder that ships: two small ONNX files and their card.

Pictures may be of any size whose sides are multiples of 16. The encoder also comes with 8-bit
weights and activations, which halves its time on processors that multiply those faster.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_eval

from aquaflow.base.errors import InputError, reason_of
from aquaflow.lab.networks.compact.network import (
    COARSE,
    STRIDE,
    CompactPrior,
    Compared,
    Encoded,
    normalised,
    size_of,
)
from aquaflow.lab.networks.onnx_file import OPSET, relative_difference, write_onnx
from aquaflow.prior.folder import CARD, DECODER, ENCODER, PriorCard, sha256_of, write_card
from aquaflow.prior.runtime import INT8_ENCODER, NetworkSession, RuntimeSettings, quantise

LICENCE = "Apache-2.0; trained on generated pictures only"
LICENCE_WITH_PICTURES = "Apache-2.0; trained on generated pictures and those that training names"
"""Of the exported network, as its card says; the second where real pictures were learned from."""
WIDTH, HEIGHT = 320, 240
"""Size that parity is measured at, and as many pixels as larger pictures are brought down to."""
MOST_CELLS = 512
"""Largest side of a picture in multiples of 16."""
ONE_WAY = Compared._fields
"""Outputs of one direction of matching."""
OUTPUTS = tuple(f"{name}_{way}" for way in ("ab", "ba") for name in ONE_WAY)
"""Outputs of the decoder, from a to b and back."""
INPUTS = ("Dc_a", "Dc_b", "rays_a", "rays_b")
"""Inputs of the decoder: coarse descriptors and viewing rays of both pictures."""

Progress = Callable[[str, int, int], None]


class CompactDecoderGraph(nn.Module):
    """``Comparison`` with its outputs side by side."""

    def __init__(self, network: CompactPrior) -> None:
        super().__init__()
        self.comparison = network.comparison

    def forward(
        self,
        Dc_a: Tensor,  # [1, d, h, w]
        Dc_b: Tensor,  # [1, d, h', w']
        rays_a: Tensor,  # [1, 2, h, w]
        rays_b: Tensor,  # [1, 2, h', w']
    ) -> tuple[Tensor, ...]:
        """The outputs, as OUTPUTS names them."""
        one, other = self.comparison(Dc_a, Dc_b, rays_a, rays_b)
        return (*one, *other)


@torch.no_grad()
def export(
    network: CompactPrior,
    folder: Path,
    training: dict[str, Any],
    calibration: Sequence[npt.NDArray[np.float32]],  # [1, 3, H, W] in [0, 1]
    progress: Progress,
) -> PriorCard:
    """Write the prior to ``folder``, in the place of one that is there; returns its card.

    Raises:
        InputError: ``folder`` holds something that is no prior.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()) and not (folder / CARD).is_file():
        raise InputError(f"{folder} is not empty; give a new folder")
    frozen = fold(network)
    progress("export", 0, 3)
    _write_encoder(frozen, folder / ENCODER)
    progress("export", 1, 3)
    _write_decoder(frozen, folder / DECODER)
    progress("export", 2, 3)
    quantise(folder / ENCODER, folder / INT8_ENCODER, calibration)
    card = PriorCard(
        name="compact",
        width=WIDTH,
        height=HEIGHT,
        descriptor=network.size.fine,
        metric=False,
        licence=LICENCE_WITH_PICTURES if training.get("pictures") else LICENCE,
        opset=OPSET,
        files={name: sha256_of(folder / name) for name in (ENCODER, DECODER, INT8_ENCODER)},
        parity=parity_of(network, folder),
        training=training,
    )
    write_card(folder, card)
    progress("export", 3, 3)
    return card


@torch.no_grad()
def parity_of(
    network: CompactPrior, folder: Path, width: int = WIDTH, height: int = HEIGHT
) -> dict[str, float]:
    """Largest relative difference between torch and ONNX of each output, for random inputs.

    Cells that are compared are like one other each, so that rounding never decides between matches.
    """
    network = network.eval()
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, height, width, generator=generator)
    cells = (1, network.size.coarse, height // COARSE, width // COARSE)
    first, noise = (torch.randn(cells, generator=generator) for _ in "ab")
    pair = [F.normalize(x, dim=1) for x in (first, torch.lerp(first, noise, 0.1))]
    inputs = dict(zip(INPUTS, (*pair, *_random_rays(height, width)), strict=True))
    one, other = network.comparison(*inputs.values())
    expected = dict(zip(Encoded._fields, network.encode(image), strict=True))
    expected |= dict(zip(OUTPUTS, (*one, *other), strict=True))
    settings = RuntimeSettings(device="cpu")
    found = NetworkSession(folder / ENCODER, settings)({"image": image.numpy()})
    given = {name: value.numpy() for name, value in inputs.items()}
    found |= NetworkSession(folder / DECODER, settings)(given)
    return {name: relative_difference(expected[name].numpy(), found[name]) for name in expected}


def load_checkpoint(path: Path) -> CompactPrior:
    """The network of a training's checkpoint, of whatever size.

    Raises:
        InputError: the file is missing or holds no such network.
    """
    try:
        weights = torch.load(path, weights_only=True, map_location="cpu")["network"]
        network = CompactPrior(size_of(weights))
        network.load_state_dict(weights)
    except Exception as error:  # the unpickler lets through whatever damaged bytes make it do
        raise InputError(
            f"{path} is no checkpoint of `lab prior train compact` ({reason_of(error)}); "
            "give another"
        ) from error
    return network.eval()


def fold(network: CompactPrior) -> CompactPrior:
    """A copy for inference, its normalisations folded into the convolutions before them."""
    network = copy.deepcopy(network).eval()
    network.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    for module, index, conv, norm in normalised(network):
        module[index] = fuse_conv_bn_eval(conv, norm)
        module[index + 1] = nn.Identity()
    return network


def _write_encoder(network: CompactPrior, path: Path) -> None:
    rows, columns = (torch.export.Dim(name, min=1, max=MOST_CELLS) for name in ("rows", "columns"))
    image = torch.zeros(1, 3, HEIGHT, WIDTH)
    sizes = ({2: STRIDE * rows, 3: STRIDE * columns},)
    write_onnx(network.encoder, (image,), ["image"], Encoded._fields, path, sizes)


def _write_decoder(network: CompactPrior, path: Path) -> None:
    scale = STRIDE // COARSE
    shapes = []
    for view in "ab":
        rows, columns = (
            scale * torch.export.Dim(f"{name}_{view}", min=1, max=MOST_CELLS)
            for name in ("rows", "columns")
        )
        shapes.append({2: rows, 3: columns})
    cells = (HEIGHT // COARSE, WIDTH // COARSE)
    descriptors = torch.zeros(2, 1, network.size.coarse, *cells)
    rays = _random_rays(HEIGHT, WIDTH)
    example = (descriptors[0], descriptors[1], rays[0], rays[1])
    write_onnx(CompactDecoderGraph(network), example, INPUTS, OUTPUTS, path, (*shapes, *shapes))


def _random_rays(height: int, width: int) -> Tensor:
    """[2, 1, 2, h, w]: no camera's; they only have to differ from each other."""
    generator = torch.Generator().manual_seed(1)
    return torch.rand(2, 1, 2, height // COARSE, width // COARSE, generator=generator) - 0.5
