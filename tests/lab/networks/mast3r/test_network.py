"""The full-size two-view network: its layout, its parts against their definitions, its outputs."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aquaflow.lab.networks.mast3r.network import (
    FULL,
    PATCH_PX,
    TINY,
    Attention,
    CrossAttention,
    Mast3r,
    ViewGeometry,
    rotary_table,
)

KEYS = Path(__file__).parents[5] / "shared" / "design" / "mast3r_keys.txt"
LAYOUT_SHA256 = "1e4692eac072c410a86211e06a9a3007d91134cf353bbabe874b0006754f9cc4"
"""Of the sorted lines "name shape" of the public checkpoint."""


def layout(network: Mast3r) -> list[str]:
    return sorted(f"{name} {list(x.shape)}" for name, x in network.state_dict().items())


def tiny(seed: int = 0) -> Mast3r:
    torch.manual_seed(seed)
    return Mast3r(TINY).eval()


def pictures(rows: int, columns: int, count: int = 1, seed: int = 0) -> Tensor:
    rng = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, rows * PATCH_PX, columns * PATCH_PX, generator=rng)


def test_full_size_has_the_names_and_shapes_of_the_public_checkpoint() -> None:
    with torch.device("meta"):
        network = Mast3r(FULL)
    lines = layout(network)
    assert len(lines) == 1017
    assert hashlib.sha256("\n".join(lines).encode()).hexdigest() == LAYOUT_SHA256


def test_layout_is_that_of_the_design_notes() -> None:
    if not KEYS.exists():
        pytest.skip(f"{KEYS} is not on this machine")
    text = KEYS.read_text().split("# full list")[1]
    with torch.device("meta"):
        network = Mast3r(FULL)
    assert layout(network) == sorted(
        " ".join(line.split("\t")) for line in text.split("\n") if line
    )


def test_full_size_gives_outputs_of_the_pictures_size_on_the_meta_device() -> None:
    with torch.device("meta"):
        network, image = Mast3r(FULL), torch.rand(1, 3, 384, 512)
        assert network.encode(image).shape == (1, 768, 1024)
        for view in network(image, image):
            assert view.X.shape == (1, 384, 512, 3)
            assert view.Q.shape == view.C.shape == (1, 384, 512)
            assert view.D.shape == (1, 384, 512, 24)


@pytest.mark.parametrize(("rows", "columns"), [(2, 3), (3, 4), (5, 5), (1, 1)])
def test_any_number_of_tokens_is_taken(rows: int, columns: int) -> None:
    images = pictures(rows, columns, 2)
    for view in tiny()(images, images.flip(3)):
        assert view.X.shape == (2, rows * PATCH_PX, columns * PATCH_PX, 3)
        assert all(bool(torch.isfinite(value).all()) for value in view)


def test_outputs_keep_their_ranges() -> None:
    for view in tiny()(pictures(2, 3), pictures(2, 3, seed=1)):
        assert bool((view.Q > 1.0).all())
        assert bool((view.C > 0.0).all())
        assert torch.allclose(view.D.norm(dim=-1), torch.ones(()), atol=1e-5)


def test_wild_activations_stay_finite() -> None:
    network = tiny()
    with torch.no_grad():
        for head in (network.downstream_head1, network.downstream_head2):
            head.dpt.head[-1].weight.mul_(1e6)  # type: ignore[operator,union-attr]
            head.head_local_features.fc2.weight.mul_(1e6)  # type: ignore[operator,union-attr]
    for view in network(pictures(2, 2), pictures(2, 2, seed=1)):
        assert all(bool(torch.isfinite(value).all()) for value in view)


def test_heads_compute_in_32_bits_under_autocast() -> None:
    """As in the published network: 16-bit heads put points ten times further off."""
    network, images = tiny(), pictures(3, 4, 2)
    kinds: dict[bool, set[torch.dtype]] = {True: set(), False: set()}

    def note(name: str) -> Callable[[nn.Module, object, object], None]:
        def hook(module: nn.Module, given: object, found: object) -> None:
            if isinstance(found, Tensor) and isinstance(module, nn.Linear | nn.Conv2d):
                kinds[name.startswith("downstream_head")].add(found.dtype)

        return hook

    for name, module in network.named_modules():
        module.register_forward_hook(note(name))
    with torch.no_grad():
        exact = network(images, images.flip(3))
        kinds[True].clear()
        kinds[False].clear()
        with torch.autocast("cpu", torch.bfloat16):
            found = network(images, images.flip(3))
    assert kinds == {True: {torch.float32}, False: {torch.bfloat16}}
    for view, other in zip(exact, found, strict=True):
        off = (view.X - other.X).norm(dim=-1) / view.X.norm(dim=-1)
        assert float(off.median()) < 1e-3  # 3e-3 to 5e-3 with heads in 16 bits


def test_a_cached_encoding_decodes_as_the_pair_does() -> None:
    network, a, b = tiny(), pictures(2, 3), pictures(2, 3, seed=1)
    whole = network(a, b)
    cached = network.decode(network.encode(a), network.encode(b), 2, 3)
    for view, same in zip(whole, cached, strict=True):
        assert all(torch.equal(x, y) for x, y in zip(view, same, strict=True))


def test_each_view_is_told_of_the_other() -> None:
    network, a = tiny(), pictures(2, 3)
    first = network(a, pictures(2, 3, seed=1))
    second = network(a, pictures(2, 3, seed=2))
    assert not torch.allclose(first[0].X, second[0].X)


def test_all_parameters_but_the_unused_ones_are_learned() -> None:
    network = tiny()
    views: list[ViewGeometry] = list(network(pictures(3, 2), pictures(3, 2, seed=1)))
    torch.stack([value.sum() for view in views for value in view]).sum().backward()  # type: ignore[no-untyped-call]
    idle = {name for name, x in network.named_parameters() if x.grad is None}
    unused = {f"downstream_head{i}.dpt.scratch.refinenet4.resConfUnit1." for i in (1, 2)}
    assert all(name == "mask_token" or name.startswith(tuple(unused)) for name in idle)


def test_rotary_scores_depend_on_the_offset_alone() -> None:
    rows, columns, width = 4, 5, 8
    table = rotary_table(rows, columns, width, 100.0)
    rng = torch.Generator().manual_seed(0)
    q, k = torch.randn(2, width, generator=rng)
    everywhere = torch.ones(1, 1, rows * columns, 1)
    scores = (table.turn(q * everywhere) @ table.turn(k * everywhere).mT)[0, 0]
    grid = scores.reshape(rows, columns, rows, columns)
    assert torch.allclose(grid[0, 1, 2, 3], grid[1, 2, 3, 4], atol=1e-5)
    assert torch.allclose(grid[3, 4, 1, 0], grid[2, 4, 0, 0], atol=1e-5)
    assert not torch.allclose(grid[0, 1, 2, 3], grid[0, 0, 2, 3], atol=1e-3)


def test_rotary_turns_a_pair_of_channels_by_position_times_frequency() -> None:
    table = rotary_table(1, 3, 8, 100.0)
    x = torch.zeros(1, 1, 3, 8)
    x[..., 5] = 1.0  # second frequency of the column's half: 100^(-2/4) = 0.1
    turned = table.turn(x)[0, 0]
    assert torch.allclose(turned[2, 5], torch.tensor(math.cos(0.2)))
    assert torch.allclose(turned[2, 7], torch.tensor(math.sin(0.2)))


def test_cross_attention_is_softmax_of_scaled_products() -> None:
    torch.manual_seed(0)
    attention, table = CrossAttention(8, 2), rotary_table(2, 3, 4, 100.0)
    x, y = torch.randn(2, 1, 6, 8)
    mixed = []
    for head in range(2):
        part = slice(4 * head, 4 * head + 4)
        q = table.turn(attention.projq(x)[None, ..., part])[0]
        k = table.turn(attention.projk(y)[None, ..., part])[0]
        mixed.append(torch.softmax(q @ k.mT / 2.0, -1) @ attention.projv(y)[..., part])
    expected = attention.proj(torch.cat(mixed, -1))
    assert torch.allclose(attention(x, y, table, table), expected, atol=1e-6)


def test_self_attention_is_cross_attention_with_itself() -> None:
    torch.manual_seed(0)
    own, cross, table = Attention(8, 2), CrossAttention(8, 2), rotary_table(2, 2, 4, 100.0)
    parts = zip((cross.projq, cross.projk, cross.projv), own.qkv.weight.chunk(3), strict=True)
    biases = own.qkv.bias.chunk(3)
    for (layer, weight), bias in zip(parts, biases, strict=True):
        layer.weight.data, layer.bias.data = weight, bias
    cross.proj.load_state_dict(own.proj.state_dict())
    x = torch.randn(1, 4, 8)
    assert torch.allclose(own(x, table), cross(x, x, table, table), atol=1e-6)


def test_patches_are_read_row_by_row() -> None:
    network, image = tiny(), pictures(2, 3)
    tokens = network.patch_embed(image)
    weight, bias = network.patch_embed.proj.weight, network.patch_embed.proj.bias
    patch = image[:, :, PATCH_PX:, :PATCH_PX]  # second row, first column: the fourth token
    assert torch.allclose(tokens[:, 3], F.conv2d(patch, weight, bias).flatten(1), atol=1e-6)
