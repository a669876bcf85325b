"""Where a training may start instead of at random: at exported weights, in a network as large or
larger, that computes what they compute.

An exported network has no normalisations left. They come back with the statistics of some pictures,
so that training goes on as if they had never been folded. A larger network has the weights of the
smaller one among its own, and its new channels, with random weights, do not act on the old ones
until they have learned to.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.lab.networks.compact.network import (
    CompactPrior,
    NetworkSize,
    cell_rays,
    normalised,
    size_of,
)
from aquaflow.lab.training.pairs import Pair
from aquaflow.prior.folder import DECODER, ENCODER, read_card

SHARPNESS = "exp"
"""Name of the decoder's constant: the inverse temperature of coarse matches."""


@torch.no_grad()
def started(folder: Path, size: NetworkSize, pair: Pair) -> CompactPrior:
    """The network of an exported compact prior, in ``size``; ``pair``, a batch like those of
    training, gives the statistics of its normalisations.

    Raises:
        InputError: there is no compact prior, or it is larger than ``size``.
        AquaFlowError: onnx is not installed.
    """
    if read_card(folder).name != "compact":
        raise InputError(f"{folder} is no compact prior; give the folder of an exported one")
    network = exported_network(folder)
    _normalise_again(network, pair)
    return network if network.size == size else grow(network, size)


@torch.no_grad()
def exported_network(folder: Path) -> CompactPrior:
    """The network of ONNX files, its normalisations doing nothing.

    Raises:
        InputError: the files are of no compact prior.
        AquaFlowError: onnx is not installed.
    """
    weights = {f"encoder.{k}": v for k, v in _weights_of(folder / ENCODER).items()}
    weights |= _weights_of(folder / DECODER)
    try:
        network = CompactPrior(size_of(weights)).eval()
        sharpness = weights[SHARPNESS].log()
        network.comparison.sharpness.copy_(sharpness)
        network.fine_sharpness.copy_(sharpness)  # not in the files; learnt anew from there
        followed = {id(conv): norm for _, _, conv, norm in normalised(network)}
        for name, layer in network.named_modules():
            if isinstance(layer, nn.Conv2d):
                layer.weight.copy_(weights[f"{name}.weight"])
                bias = weights[f"{name}.bias"]
                norm = followed.get(id(layer))
                if norm is None:
                    assert layer.bias is not None
                    layer.bias.copy_(bias)
                else:
                    norm.bias.copy_(bias)
                    norm.weight.fill_((1.0 + norm.eps) ** 0.5)
    except (KeyError, RuntimeError) as error:
        raise InputError(f"{folder} has other weights than a compact prior ({error})") from error
    return network


def grow(network: CompactPrior, size: NetworkSize) -> CompactPrior:
    """A larger network of the same function.

    Raises:
        InputError: it would not be larger everywhere, or has other descriptors.
    """
    larger = CompactPrior(size)
    weights = larger.state_dict()
    for name, old in network.state_dict().items():
        new = weights[name]
        if any(n < o for n, o in zip(new.shape, old.shape, strict=True)):
            raise InputError("a network cannot shrink; give a --size that is no smaller")
        if old.dim() == 4:  # old channels take nothing from new ones
            new[: old.shape[0]] = 0.0
        new[tuple(slice(side) for side in old.shape)] = old
    larger.load_state_dict(weights)
    return larger.train(network.training)


def _normalise_again(network: CompactPrior, pair: Pair) -> None:
    """Statistics as the pair has them, taken back by scale and shift: the function stays."""
    norms = [norm for _, _, _, norm in normalised(network)]
    seen: dict[nn.Module, list[Tensor]] = {norm: [] for norm in norms}

    def see(norm: nn.Module, inputs: tuple[Any, ...]) -> None:
        seen[norm].append(inputs[0].transpose(0, 1).flatten(1))

    hooks = [norm.register_forward_pre_hook(see) for norm in norms]
    a, b = network.encode(pair.a.image), network.encode(pair.b.image)
    height, width = pair.a.depth.shape[-2:]
    network.comparison(a.Dc, b.Dc, *(cell_rays(v.K, height, width) for v in (pair.a, pair.b)))
    for hook in hooks:
        hook.remove()
    for norm in norms:
        variance, mean = torch.var_mean(torch.cat(seen[norm], 1), 1)
        assert norm.running_mean is not None
        assert norm.running_var is not None
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
        norm.weight.copy_((variance + norm.eps).sqrt())
        norm.bias.add_(mean)


def _weights_of(path: Path) -> dict[str, Tensor]:
    try:
        import onnx
    except ImportError as error:
        raise AquaFlowError(
            "a start from exported weights needs onnx; pip install 'aquaflow[export]'"
        ) from error
    graph = onnx.load(str(path)).graph
    return {
        each.name: torch.from_numpy(onnx.numpy_helper.to_array(each).copy())
        for each in graph.initializer
    }
