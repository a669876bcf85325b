"""The choice of the prior: what was asked for, or the safety net with a word about why."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from aquaflow.base.errors import AquaFlowError, InputError
from aquaflow.config import PriorConfig
from aquaflow.prior import factory
from aquaflow.prior.factory import make_prior
from aquaflow.prior.folder import ENCODER
from tests.prior.stub_prior import write_stub


def test_classical_needs_nothing() -> None:
    assert make_prior(PriorConfig(kind="classical")).name == "classical"


def test_without_weights_the_safety_net_tracks_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        prior = make_prior(PriorConfig(kind="compact", folder=tmp_path))
    assert prior.name == "classical"
    [record] = caplog.records
    assert f"there are no weights in {tmp_path}" in record.message


def test_matches_that_the_network_cannot_give_are_flows_and_that_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
    folder = write_stub(tmp_path / "prior")
    with caplog.at_level(logging.WARNING):
        prior = make_prior(PriorConfig(kind="folder", folder=folder, matches="network"))
    assert prior.matching == "flow from descriptors of cells"
    assert "compact gives no descriptors of all pixels" in caplog.text


def test_without_onnxruntime_the_safety_net_tracks_and_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(factory, "find_spec", lambda name: None)
    with caplog.at_level(logging.WARNING):
        assert make_prior(PriorConfig(kind="compact")).name == "classical"
    assert "aquaflow[prior]" in caplog.text


def test_a_folder_that_was_named_is_used_or_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no prior"):
        make_prior(PriorConfig(kind="folder", folder=tmp_path))


def test_damaged_weights_are_an_error_not_a_reason_for_the_safety_net(tmp_path: Path) -> None:
    pytest.importorskip("onnx", reason="pip install 'aquaflow[export]'")
    folder = write_stub(tmp_path / "stub")
    (folder / ENCODER).write_bytes(b"other")
    with pytest.raises(InputError, match="not the file that was exported"):
        make_prior(PriorConfig(kind="compact", folder=folder))


def test_weights_that_are_there_are_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("onnx", reason="pip install 'aquaflow[export]'")
    pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
    folder = write_stub(tmp_path / "stub")
    prior = make_prior(PriorConfig(kind="compact", folder=folder, device="cpu"))
    assert prior.name == "compact"
    assert not caplog.records


def test_a_device_that_was_named_is_used_or_an_error(tmp_path: Path) -> None:
    pytest.importorskip("onnx", reason="pip install 'aquaflow[export]'")
    ort = pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
    if "CUDAExecutionProvider" in ort.get_available_providers():
        pytest.skip("this onnxruntime has CUDA")
    folder = write_stub(tmp_path / "stub")
    with pytest.raises(AquaFlowError, match="CUDAExecutionProvider"):
        make_prior(PriorConfig(kind="compact", folder=folder, device="cuda"))
