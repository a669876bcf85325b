"""Loading a checkpoint: what fits is loaded, what does not is refused in one sentence."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import pytest
import torch

from aquaflow.base.errors import InputError
from aquaflow.lab.networks.mast3r.export import load_checkpoint
from aquaflow.lab.networks.mast3r.network import TINY, Mast3r


@pytest.fixture
def network() -> Mast3r:
    torch.manual_seed(0)
    return Mast3r(TINY).eval()


def test_a_checkpoint_with_its_arguments_loads_to_the_same_network(
    network: Mast3r, tmp_path: Path
) -> None:
    path = tmp_path / "weights.pth"
    torch.save({"args": argparse.Namespace(epochs=3), "model": network.state_dict()}, path)
    image = torch.rand(1, 3, 32, 32)
    loaded = load_checkpoint(path, TINY)
    for view, same in zip(network(image, image), loaded(image, image), strict=True):
        assert all(torch.equal(x, y) for x, y in zip(view, same, strict=True))
    assert not any(x.requires_grad for x in loaded.parameters())


def test_half_precision_weights_are_widened(network: Mast3r, tmp_path: Path) -> None:
    torch.save({k: v.half() for k, v in network.state_dict().items()}, tmp_path / "half.pth")
    loaded = load_checkpoint(tmp_path / "half.pth", TINY)
    assert {x.dtype for x in loaded.parameters()} == {torch.float32}


def test_tied_layers_stay_tied(network: Mast3r, tmp_path: Path) -> None:
    torch.save(network.state_dict(), tmp_path / "weights.pth")
    scratch = load_checkpoint(tmp_path / "weights.pth", TINY).downstream_head2.dpt.scratch
    assert scratch.layer3_rn.weight is scratch.layer_rn[2].weight


def test_missing_unknown_and_misshapen_tensors_are_named(network: Mast3r, tmp_path: Path) -> None:
    state = network.state_dict()
    del state["enc_norm.bias"]
    state["dec_norm.bias"] = torch.zeros(3)
    state["extra"] = torch.zeros(1)
    torch.save(state, tmp_path / "other.pth")
    with pytest.raises(InputError) as error:
        load_checkpoint(tmp_path / "other.pth", TINY)
    for part in (
        "enc_norm.bias is missing",
        "extra is unknown",
        "dec_norm.bias is (3,), not (32,)",
    ):
        assert part in str(error.value)


def test_many_problems_are_counted(tmp_path: Path) -> None:
    torch.save({"nothing": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(InputError, match=r"and \d+ more"):
        load_checkpoint(tmp_path / "other.pth", TINY)


class Malicious:
    """A pickle that would run a command."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.trace}",)


def test_code_in_a_checkpoint_is_not_run(tmp_path: Path) -> None:
    torch.save({"model": Malicious(tmp_path / "trace")}, tmp_path / "evil.pth")
    with pytest.raises(InputError, match="cannot be read as a checkpoint"):
        load_checkpoint(tmp_path / "evil.pth", TINY)
    assert not (tmp_path / "trace").exists()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"\x80\x02garbage"])
def test_a_file_that_is_no_checkpoint_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "file.pth").write_bytes(content)
    with pytest.raises(InputError, match="download it again"):
        load_checkpoint(tmp_path / "file.pth", TINY)


def test_no_file_and_no_tensors_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no checkpoint"):
        load_checkpoint(tmp_path / "absent.pth", TINY)
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(InputError, match="holds no tensors"):
        load_checkpoint(tmp_path / "list.pth", TINY)
