"""`aquaflow lab prior describe`: a network of the user's own becomes a prior, or a sentence says
why not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from aquaflow import cli
from aquaflow.base.errors import AquaFlowError
from aquaflow.prior.folder import read_card
from tests.prior.tiny_depth import write_network

pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
pytest.importorskip("onnx", reason="pip install 'aquaflow[export]'")

USUAL = ["--measure", "inverse_depth", "--unit", "affine", "--output", "depth"]


def run(network: Path, *options: str) -> Result:
    out = network.parent / "prior"
    return CliRunner().invoke(
        cli.app, ["lab", "prior", "describe", str(network), "--out", str(out), *options]
    )


def test_a_network_becomes_a_prior_with_a_checksum(tmp_path: Path) -> None:
    network = write_network(tmp_path / "net.onnx", (56, 70))
    found = run(network, *USUAL, "--licence", "Apache-2.0", "--json")
    assert found.exit_code == 0, found.output
    result = json.loads(found.stdout)
    assert (result["width"], result["height"], result["known"]) == (70, 56, 1.0)
    card = read_card(tmp_path / "prior")
    assert (card.name, card.licence, card.metric) == ("depth", "Apache-2.0", False)
    assert card.depth is not None
    assert (card.depth.input, card.depth.multiple_px) == ("image", 1)


def test_weights_in_a_file_of_their_own_come_with_it(tmp_path: Path) -> None:
    network = write_network(tmp_path / "net.onnx", (56, 70))
    (tmp_path / "net.onnx_data").write_bytes(b"weights")
    assert run(network, *USUAL).exit_code == 0
    assert set(read_card(tmp_path / "prior").files) == {"network.onnx", "net.onnx_data"}


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (USUAL[:4], "the outputs depth, sure; choose with --output"),
        (USUAL, "give --multiple"),
        ([*USUAL[:2], "--unit", "inches", *USUAL[4:], "--multiple", "8"], "--unit: "),
        (["--measure", "depth", *USUAL[2:], "--multiple", "8"], "affine is of inverse_depth only"),
        ([*USUAL, "--multiple", "8", "--mean", "0.5"], "--mean is '0.5'; give three numbers"),
        ([*USUAL, "--multiple", "8", "--std", "0,1,1"], "std must be positive"),
        ([*USUAL, "--multiple", "8", "--input", "picture"], "takes image and not picture"),
    ],
)
def test_what_is_missing_or_wrong_is_a_sentence(
    options: list[str], sentence: str, tmp_path: Path
) -> None:
    found = run(write_network(tmp_path / "net.onnx"), *options)
    assert isinstance(found.exception, AquaFlowError)
    assert sentence in str(found.exception)
    assert not (tmp_path / "prior").exists()


def test_a_size_that_the_network_cannot_take_is_a_sentence(tmp_path: Path) -> None:
    network = write_network(tmp_path / "net.onnx", ("height", 64))
    found = run(network, *USUAL, "--multiple", "14")
    assert isinstance(found.exception, AquaFlowError)
    assert "cannot take a picture of 518 x 392 px" in str(found.exception)


def test_a_folder_that_is_not_empty_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "prior").mkdir()
    (tmp_path / "prior" / "notes.txt").write_text("mine")
    found = run(write_network(tmp_path / "net.onnx", (56, 70)), *USUAL)
    assert "is not empty" in str(found.exception)
    assert (tmp_path / "prior" / "notes.txt").read_text() == "mine"


def test_a_file_that_is_no_network_or_not_there_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "net.onnx").write_bytes(b"no network")
    assert "cannot be run" in str(run(tmp_path / "net.onnx", *USUAL).exception)
    assert "is no file" in str(run(tmp_path / "other.onnx", *USUAL).exception)
