"""The big prior as ONNX: what runs is what torch computes, and nothing falls back unseen."""

from __future__ import annotations

import builtins
import json
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from aquaflow import cli
from aquaflow.base.errors import AquaFlowError, ArgumentError, InputError
from aquaflow.config import PriorConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.lab.networks.mast3r.export import OUTPUTS, export, parity_of, relative_difference
from aquaflow.lab.networks.mast3r.network import TINY, Mast3r
from aquaflow.prior import runtime
from aquaflow.prior.factory import make_prior
from aquaflow.prior.folder import CARD, DECODER, ENCODER, read_card
from aquaflow.prior.hybrid import HybridEncoding
from aquaflow.prior.runtime import NetworkSession, RuntimeSettings

pytestmark = [pytest.mark.ci, pytest.mark.usefixtures("onnxscript")]

pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")

WIDTH, HEIGHT = 48, 32
CPU = RuntimeSettings(device="cpu")


def silent(stage: str, done: int, total: int) -> None:
    """No progress bar."""


def tiny() -> Mast3r:
    torch.manual_seed(0)
    return Mast3r(TINY)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("exported") / "prior"
    export(tiny(), out, WIDTH, HEIGHT, "none", silent)
    return out


def test_every_output_is_torchs_to_1e_4(folder: Path) -> None:
    parity = read_card(folder).parity
    assert set(parity) == {"tokens", *OUTPUTS}
    assert max(parity.values()) <= 1e-4


def test_a_session_gives_what_the_network_gives(folder: Path) -> None:
    network, image = tiny().eval(), torch.rand(2, 1, 3, HEIGHT, WIDTH)
    encoder, decoder = NetworkSession(folder / ENCODER, CPU), NetworkSession(folder / DECODER, CPU)
    a, b = (encoder({"image": x.numpy()})["tokens"] for x in image)
    found = decoder({"tokens_a": a, "tokens_b": b})
    with torch.no_grad():
        first, second = network(*image)
    for name, expected in zip(OUTPUTS, (*first, *second), strict=True):
        np.testing.assert_allclose(found[name], expected, rtol=1e-3, atol=1e-4)


def test_the_papers_network_tells_cells_apart_behind_the_hybrid_prior(folder: Path) -> None:
    prior = make_prior(PriorConfig(kind="folder", folder=folder, device="cpu"))
    assert (prior.name, prior.metric) == ("mast3r", True)
    camera = CameraModel(96, 64, 90.0, 90.0, 48.0, 32.0)
    image = np.random.default_rng(0).integers(0, 256, (64, 96, 3)).astype(np.uint8)
    a, b = prior.encode(image, camera), prior.encode(image, camera)
    assert isinstance(a, HybridEncoding)
    cells, same = a.describer.compare(a.features, b.features, camera, camera).cells
    assert cells.shape == same.shape == (HEIGHT // 8, WIDTH // 8, TINY.descriptor)
    np.testing.assert_allclose(np.linalg.norm(cells, axis=-1), 1.0, atol=1e-4)
    pair = prior.decode(a, b)
    assert pair.matches.shape == (64, 96, 2)
    for X in (pair.X_a, pair.X_b):
        assert X is not None
        assert np.isfinite(X).all()


def test_other_weights_are_found_out(folder: Path) -> None:
    torch.manual_seed(1)
    assert max(parity_of(Mast3r(TINY), folder, WIDTH, HEIGHT).values()) > 1e-2


def test_difference_is_relative_to_the_largest_value() -> None:
    expected, found = np.float32([0.0, 10.0]), np.float32([0.1, 10.0])
    assert relative_difference(expected, found) == pytest.approx(0.01)


@pytest.mark.parametrize(("width", "height"), [(50, 32), (48, 0), (48, 31)])
def test_a_size_that_is_no_multiple_of_16_is_refused(
    width: int, height: int, tmp_path: Path
) -> None:
    with pytest.raises(ArgumentError, match="multiples of 16"):
        export(tiny(), tmp_path / "out", width, height, "none", silent)


def test_a_folder_in_use_is_not_written_to(folder: Path) -> None:
    with pytest.raises(InputError, match="is not empty"):
        export(tiny(), folder, WIDTH, HEIGHT, "none", silent)


def test_a_gpu_that_is_not_there_is_an_error_and_auto_takes_the_cpu(folder: Path) -> None:
    if "CUDAExecutionProvider" in runtime._onnxruntime().get_available_providers():
        pytest.skip("this onnxruntime has CUDA")
    with pytest.raises(AquaFlowError, match="install onnxruntime-gpu"):
        NetworkSession(folder / ENCODER, RuntimeSettings(device="cuda"))
    assert NetworkSession(folder / ENCODER, RuntimeSettings(device="auto")).device == "cpu"


class FallsBack:
    """An onnxruntime that promises CUDA and gives a CPU session."""

    def __init__(self, real: Any) -> None:
        self.__file__ = real.__file__
        self.SessionOptions = real.SessionOptions

    def get_available_providers(self) -> list[str]:
        return ["CUDAExecutionProvider", "CPUExecutionProvider"]

    def InferenceSession(self, *arguments: Any, **options: Any) -> Any:
        return types.SimpleNamespace(get_providers=lambda: ["CPUExecutionProvider"])


def test_a_silent_fall_back_to_the_cpu_is_an_error(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretended = FallsBack(runtime._onnxruntime())
    monkeypatch.setattr(runtime, "_onnxruntime", lambda: pretended)
    with pytest.raises(AquaFlowError, match="fell back to CPUExecutionProvider"):
        NetworkSession(folder / ENCODER, RuntimeSettings(device="cuda"))


def test_tensorrt_keeps_its_engines_and_slower_providers_follow(tmp_path: Path) -> None:
    providers = runtime._providers("tensorrt", RuntimeSettings(engine_cache=tmp_path))
    assert [name for name, _ in providers] == [
        runtime.PROVIDERS[name] for name in ("tensorrt", "cuda", "cpu")
    ]
    assert providers[0][1]["trt_engine_cache_path"] == str(tmp_path)


def test_a_file_that_is_no_network_is_refused(tmp_path: Path) -> None:
    (tmp_path / "encoder.onnx").write_bytes(b"not a network")
    with pytest.raises(InputError, match="cannot be run"):
        NetworkSession(tmp_path / "encoder.onnx", CPU)


def absent(name: str) -> Callable[..., Any]:
    real = builtins.__import__

    def without(module: str, *rest: Any, **named: Any) -> Any:
        if module.split(".", maxsplit=1)[0] == name:
            raise ImportError(module)
        return real(module, *rest, **named)

    return without


def test_without_onnxruntime_the_extra_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(builtins, "__import__", absent("onnxruntime"))
    with pytest.raises(AquaFlowError, match=r"aquaflow\[prior\]"):
        NetworkSession(folder / ENCODER, CPU)


def test_without_onnxscript_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(builtins, "__import__", absent("onnxscript"))
    with pytest.raises(AquaFlowError, match=r"aquaflow\[export\]"):
        export(tiny(), tmp_path / "out", WIDTH, HEIGHT, "none", silent)


def test_verify_reports_each_output(folder: Path) -> None:
    result = CliRunner().invoke(cli.app, ["lab", "prior", "verify", str(folder), "--json"])
    outputs = json.loads(result.stdout)["outputs"]
    assert {row["name"] for row in outputs} == {"tokens", *OUTPUTS}
    assert all(row["prior"] == "mast3r" and row["max_rel"] <= 1e-4 for row in outputs)


def test_verify_refuses_a_prior_that_differs_from_torch(folder: Path, tmp_path: Path) -> None:
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    card = json.loads((folder / CARD).read_text())
    (tmp_path / CARD).write_text(json.dumps(card | {"parity": {"X_a": 0.01}}))
    result = CliRunner().invoke(cli.app, ["lab", "prior", "verify", str(tmp_path)])
    assert isinstance(result.exception, AquaFlowError)
    assert "differs from torch by 1.0e-02" in str(result.exception)


def test_export_shows_the_licence_before_it_reads_weights(tmp_path: Path) -> None:
    arguments = ["lab", "prior", "export", "mast3r", "--checkpoint", str(tmp_path / "absent.pth")]
    result = CliRunner().invoke(cli.app, arguments)
    assert "not for commercial use" in result.output
    assert isinstance(result.exception, InputError)
