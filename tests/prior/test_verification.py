"""A prior that says something else on another processor is found out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from aquaflow import cli
from aquaflow.base.errors import AquaFlowError
from aquaflow.prior import runtime
from aquaflow.prior.describe import describe, difference
from aquaflow.prior.factory import SHIPPED
from tests.prior.pretended_gpu import Fault, PretendedGpu
from tests.prior.tiny_depth import card, write_network

pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
pytest.importorskip("onnx", reason="pip install 'aquaflow[export]'")

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def depth(tmp_path: Path) -> Path:
    network = write_network(tmp_path / "net.onnx", (48, 64))
    folder = tmp_path / "prior"
    describe(network, folder, card(), 64, 48, "ours")
    return folder


def verify(folder: Path, *options: str) -> Result:
    return CliRunner().invoke(cli.app, ["lab", "prior", "verify", str(folder), *options])


def pretend(monkeypatch: pytest.MonkeyPatch, fault: Fault, device: str = "cuda") -> None:
    monkeypatch.setattr(runtime, "_onnxruntime", lambda: PretendedGpu(device, fault))


@pytest.mark.parametrize("precision", ["fp32", "int8"])
def test_the_shipped_prior_agrees_with_itself_here(precision: str) -> None:
    found = verify(SHIPPED, "--device", "cpu", "--precision", precision, "--json")
    assert found.exit_code == 0, found.output
    rows = {row["name"]: row["max_rel"] for row in json.loads(found.stdout)["on_device"]}
    assert {"features_a", "cells_b", "log_range_a", "log_sigma_b"} <= set(rows)
    worst = max(rows.values())
    assert worst == 0.0 if precision == "fp32" else 0.0 < worst <= 0.25


def test_a_processor_that_agrees_passes(depth: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, lambda name, x: x * np.float32(1.0 + 1e-5))
    found = verify(depth, "--device", "cuda")
    assert found.exit_code == 0, found.output
    assert "device against CPU" in found.output


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(lambda name, x: 1.05 * x, id="a twentieth off"),
        pytest.param(lambda name, x: np.full_like(x, np.nan), id="no numbers"),
        pytest.param(lambda name, x: x[..., ::-1], id="mirrored"),
    ],
)
def test_a_processor_that_does_not_agree_is_a_sentence(
    fault: Fault, depth: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend(monkeypatch, fault)
    found = verify(depth, "--device", "cuda")
    assert isinstance(found.exception, AquaFlowError)
    assert "prior depth on cuda in fp32 differs from the CPU by" in str(found.exception)


def test_what_16_bits_round_off_is_agreement_in_16_bits_only(
    depth: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    pretend(monkeypatch, lambda name, x: x * np.float32(1.01), "tensorrt")
    assert verify(depth, "--device", "tensorrt", "--precision", "fp16").exit_code == 0
    assert verify(depth, "--device", "tensorrt", "--precision", "fp32").exit_code == 1


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--device", "cpu", "--precision", "fp16"], "fp16 is TensorRT's"),
        (["--device", "cpu", "--precision", "int8"], "has no encoder_int8.onnx"),
        (["--device", "npu"], "--device is 'npu'; use one of cpu, cuda, tensorrt"),
        (["--device", "cpu", "--precision", "fp8"], "--precision is 'fp8'; use one of fp32"),
        (["--checkpoint", "weights.pth"], "no network that we have in torch"),
    ],
)
def test_what_cannot_be_compared_is_a_sentence(
    options: list[str], sentence: str, depth: Path
) -> None:
    found = verify(depth, *options)
    assert isinstance(found.exception, AquaFlowError)
    assert sentence in str(found.exception)


def test_a_device_without_a_prior_is_a_sentence() -> None:
    found = CliRunner().invoke(cli.app, ["lab", "prior", "verify", "--device", "cpu"])
    assert "give the folder of a prior" in str(found.exception)


def test_without_a_device_the_files_are_checked(depth: Path) -> None:
    assert "the files are whole" in verify(depth).output
    (depth / "network.onnx").write_bytes(b"other")
    assert "not the file that was exported" in str(verify(depth).exception)


def test_few_pixels_at_the_edge_of_what_is_known_are_no_difference() -> None:
    expected = np.linspace(1.0, 2.0, 1000)
    found = expected.copy()
    found[:5] = np.nan
    assert difference(expected, found) == 0.0
    found[:50] = np.nan
    assert difference(expected, found) == np.inf
    assert difference(expected, expected[:10]) == np.inf
    assert difference(np.full(9, np.nan), np.full(9, np.nan)) == np.inf
