"""`aquaflow prior train compact`: from nothing to a folder that tracks, and its record."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from aquaflow import cli
from aquaflow.prior.compact.network import CompactPrior, Encoded, NetworkSize
from aquaflow.prior.folder import read_card
from aquaflow.training import compact_recall, compact_run
from aquaflow.training.compact_recall import held_out_pairs, tracked_recall
from aquaflow.training.compact_run import CompactRun, calibration, hardware_of, training_record
from aquaflow.training.correspondences import overlap
from aquaflow.training.pair_generator.pool import Pool
from aquaflow.training.pair_generator.scene import Detail

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = NetworkSize(levels=(8, 8, 12, 16), merged=(16, 12, 8), fine=8, coarse=16, head=4)
SMALL_POOL = partial(Pool, width=96, height=64, detail=Detail(terrain=64, texture=128))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes, network and held-out set of a size that takes seconds."""
    monkeypatch.setattr(compact_recall, "Pool", SMALL_POOL)
    monkeypatch.setattr(compact_run, "Pool", SMALL_POOL)
    monkeypatch.setattr(compact_run, "CompactPrior", partial(CompactPrior, SMALL))
    monkeypatch.setattr(compact_run, "held_out_pairs", partial(held_out_pairs, count=4))


@pytest.mark.usefixtures("small")
def test_held_out_pairs_overlap_and_are_the_same_again(tmp_path: Path) -> None:
    one, again = (held_out_pairs(tmp_path / name, count=4) for name in ("a", "b"))
    assert sum(len(pair.a.K) for pair in one) == 4
    assert all(bool((overlap(pair) >= compact_recall.LEAST_OVERLAP).all()) for pair in one)
    assert torch.equal(one[0].a.image, again[0].a.image)


@pytest.mark.usefixtures("small")
def test_flow_from_good_cells_finds_more_than_from_none(tmp_path: Path) -> None:
    pairs = held_out_pairs(tmp_path, count=4)
    where: dict[int, Tensor] = {}
    for pair in pairs:  # descriptors that know the place itself
        for view in (pair.a, pair.b):
            points = view.points() @ view.T_wc[:, None, :3, :3].mT + view.T_wc[:, None, None, :3, 3]
            waves = torch.cat([f * points for f in (0.5, 1.0, 2.0)], -1)[:, 4::8, 4::8]
            D = torch.cat([waves.sin(), waves.cos()], -1)
            where[id(view.image)] = torch.nn.functional.normalize(D, dim=-1).permute(0, 3, 1, 2)

    def knows(images: Tensor) -> Encoded:
        return Encoded(where[id(images)], where[id(images)], images)

    known, nothing = tracked_recall(knows, pairs), tracked_recall(None, pairs)
    assert known["smooth_8px"] > nothing["smooth_8px"]
    assert known["flow_2px"] > nothing["flow_2px"]


def test_the_record_holds_seeds_work_hardware_and_figures() -> None:
    run = CompactRun(seed=3, steps=10)
    rows = [{"step": 10.0, "cpu_s": 1.0, "rate": 0.1, "loss_coarse": 2.0, "fine_2px": 0.51239}]
    record = training_record(run, rows, hardware_of("cpu"))
    assert (record["seed"], record["steps"], record["pairs"]) == (3, 10, 80)
    assert record["held_out"] == {"fine_2px": 0.5124}
    assert "CPU" in record["hardware"]


@pytest.mark.usefixtures("small")
def test_calibration_shows_pictures_that_the_network_takes(tmp_path: Path) -> None:
    pictures = calibration(SMALL_POOL(tmp_path, 1))
    assert {picture.shape for picture in pictures} == {(1, 3, 64, 96)}
    assert all(picture.min() >= 0.0 and picture.max() <= 1.0 for picture in pictures)


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_the_command_trains_exports_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
    pytest.importorskip("onnxscript", reason="pip install 'aquaflow[export]'")
    options = ["--scenes", "16", "--batch", "2", "--out", str(tmp_path), "--json"]
    command = ["prior", "train", "compact", *options]
    first = CliRunner().invoke(cli.app, [*command, "--steps", "2"])
    assert first.exit_code == 0, first.output
    card = read_card(tmp_path / compact_run.PRIOR)
    assert card.training is not None
    assert json.loads(first.stdout) == card.training
    assert max(card.parity.values()) <= 1e-4
    assert set(card.training["figures"]) == {"wide", "wider"}
    again = CliRunner().invoke(cli.app, [*command, "--steps", "3"])
    assert json.loads(again.stdout)["steps"] == 3
    rows = json.loads((tmp_path / "history.json").read_text())
    assert [row["step"] for row in rows] == [2.0, 3.0]
