"""`aquaflow lab prior train compact`: from nothing to a folder that tracks, and its record."""

from __future__ import annotations

import json
import shutil
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from aquaflow import cli
from aquaflow.base.errors import InputError
from aquaflow.lab.networks.compact.export import load_checkpoint
from aquaflow.lab.networks.compact.network import Encoded, NetworkSize
from aquaflow.lab.training import compact, compact_run, held_out
from aquaflow.lab.training import compact_run as compact_figures
from aquaflow.lab.training.compact import CompactSettings
from aquaflow.lab.training.compact_recall import tracked_recall
from aquaflow.lab.training.compact_run import (
    LEAST_FACTOR,
    CompactRun,
    calibration,
    hardware_of,
    rendering_ahead,
    training_record,
    with_honest_range,
)
from aquaflow.lab.training.held_out import (
    SETS,
    check_held_out,
    held_out_pairs,
    mapped_pairs,
    turned_pictures,
)
from aquaflow.lab.training.pair_generator.cameras import TRAINING, PairMotion
from aquaflow.lab.training.pair_generator.scene import Detail
from aquaflow.lab.training.pair_generator.stored_pairs import Pool
from aquaflow.lab.training.pairs import overlap
from aquaflow.prior.factory import SHIPPED
from aquaflow.prior.folder import read_card
from tests.lab.training.small_maps import small_dive

pytestmark = pytest.mark.usefixtures("one_thread")

PLAIN = Detail()
SMALL = NetworkSize(levels=(8, 8, 12, 16), merged=(16, 12, 8), fine=8, coarse=16, head=4)
WIDE = SETS["wide"]


def small_pool(
    folder: Path, seed: int, motion: PairMotion = TRAINING, detail: Detail = PLAIN
) -> Pool:
    """With scenes and pictures of a size that takes seconds."""
    detail = Detail(terrain=64, texture=128, regular=detail.regular)
    return Pool(folder, seed, 96, 64, motion, detail)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes, network and held-out set of a size that takes seconds."""
    monkeypatch.setattr(held_out, "Pool", small_pool)
    monkeypatch.setattr(compact_run, "Pool", small_pool)
    monkeypatch.setattr(compact_run, "NetworkSize", lambda: SMALL)
    monkeypatch.setattr(compact_run, "held_out_pairs", partial(held_out_pairs, count=4))


@pytest.mark.usefixtures("small")
def test_held_out_pairs_overlap_and_are_the_same_again(tmp_path: Path) -> None:
    one, again = (held_out_pairs(tmp_path / name, WIDE, count=4) for name in ("a", "b"))
    assert sum(len(pair.a.K) for pair in one) == 4
    assert all(bool((overlap(pair) >= held_out.LEAST_OVERLAP).all()) for pair in one)
    assert torch.equal(one[0].a.image, again[0].a.image)


@pytest.mark.usefixtures("small")
def test_flow_from_good_cells_finds_more_than_from_none(tmp_path: Path) -> None:
    pairs = held_out_pairs(tmp_path, WIDE, count=4)
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
    run = CompactRun(seed=3, steps=10, maps=(Path("dives/reef"),))
    rows = [{"step": 10.0, "cpu_s": 1.0, "rate": 0.1, "loss_coarse": 2.0, "fine_2px": 0.51239}]
    record = training_record(run, rows, hardware_of("cpu"))
    assert (record["seed"], record["steps"], record["pairs"]) == (3, 10, 80)
    assert record["maps"] == ["reef"]
    assert record["held_out"] == {"fine_2px": 0.5124}
    assert "CPU" in record["hardware"]


@pytest.mark.usefixtures("small")
def test_calibration_shows_pictures_that_the_network_takes(tmp_path: Path) -> None:
    pictures = calibration(small_pool(tmp_path, 1))
    assert {picture.shape for picture in pictures} == {(1, 3, 64, 96)}
    assert all(picture.min() >= 0.0 and picture.max() <= 1.0 for picture in pictures)


def test_real_pictures_give_held_out_pairs_of_the_tracked_size(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (90, 120, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), cv2.resize(noise, (480, 360)))
    one, again = (turned_pictures([tmp_path], count=8) for _ in "ab")
    assert [pair.a.image.shape for pair in one] == [(8, 3, 240, 320)]
    assert torch.equal(one[0].b.image, again[0].b.image)
    assert float(overlap(one[0]).median()) > 0.2


def test_windows_grow_when_the_rate_falls() -> None:
    run = CompactRun(steps=100, warm_up=1)
    assert run.looks_at(0).width == run.looks_at(69).width == run.looks.width
    assert run.looks_at(70).width == run.late_looks.width > run.looks.width


@pytest.mark.parametrize(("spread", "factor"), [(0.5, LEAST_FACTOR), (1.5, 2.25)])
def test_a_variance_is_widened_where_errors_are_larger_and_never_narrowed(
    spread: float, factor: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = torch.tensor([-spread, spread])
    monkeypatch.setattr(compact_figures, "onnx_encoder", lambda path: None)
    monkeypatch.setattr(compact_figures, "onnx_comparison", lambda path: None)
    monkeypatch.setattr(compact_figures, "normalised_errors", lambda *inputs: errors)
    shipped = SHIPPED
    folder = Path(shutil.copytree(shipped, tmp_path / "prior"))
    card = with_honest_range(folder, read_card(folder), [])
    assert card.range_variance_factor == pytest.approx(factor)
    assert read_card(folder) == card


@pytest.mark.usefixtures("small")
def test_the_command_stops_when_its_hours_are_over(tmp_path: Path) -> None:
    options = ["--scenes", "8", "--batch", "2", "--steps", "3", "--out", str(tmp_path)]
    result = CliRunner().invoke(
        cli.app, ["lab", "prior", "train", "compact", *options, "--hours", "0"]
    )
    assert result.exit_code == 0, result.output
    assert "give the same command to go on" in result.stdout
    assert (tmp_path / "checkpoint.pt").is_file()
    assert not (tmp_path / compact_run.PRIOR).exists()


@pytest.mark.usefixtures("small")
def test_the_command_takes_maps_of_dives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dive = small_dive(tmp_path / "dive")
    out = tmp_path / "out"
    options = ["--scenes", "8", "--batch", "2", "--steps", "3", "--out", str(out), "--hours", "0"]
    command = ["lab", "prior", "train", "compact", *options, "--maps", str(dive)]
    monkeypatch.setattr(compact, "CompactSettings", partial(CompactSettings, map_pairs=16))
    result = CliRunner().invoke(cli.app, command)
    assert result.exit_code == 0, result.output
    assert len(list((out / compact_run.POOL).glob("map_*.pt"))) == 2
    missing = CliRunner().invoke(cli.app, [*command, "--maps", str(tmp_path / "missing")])
    assert missing.exit_code != 0
    assert "finished dive" in str(missing.exception or missing.output)


@pytest.mark.usefixtures("small")
def test_a_held_out_dive_has_figures_and_is_never_learned_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dive, other = small_dive(tmp_path / "reef"), small_dive(tmp_path / "bay", seed=1)
    monkeypatch.setattr(compact_run, "mapped_pairs", partial(mapped_pairs, count=8))
    monkeypatch.setattr(compact, "CompactSettings", partial(CompactSettings, map_pairs=8))
    out = tmp_path / "out"
    options = ["--scenes", "8", "--batch", "2", "--steps", "2", "--out", str(out)]
    command = ["lab", "prior", "train", "compact", *options, "--held-out", str(dive)]
    monkeypatch.setattr(compact_run, "has_ended", lambda history, schedule: False)
    result = CliRunner().invoke(cli.app, [*command, "--maps", str(other)])
    assert result.exit_code == 0, result.output
    row = json.loads((out / "history.json").read_text())[-1]
    assert {"fine_2px", "reef_fine_2px", "reef_log_range"} <= set(row)
    learned = {path.name[:16] for path in (out / compact_run.POOL).glob("map_*.pt")}
    held = {path.name[:16] for path in (out / held_out.HELD_OUT_MAPS).glob("map_*.pt")}
    assert len(learned) == len(held) == 1
    assert learned.isdisjoint(held)

    copy = shutil.copytree(dive, tmp_path / "copy")
    refused = CliRunner().invoke(cli.app, [*command, "--maps", str(copy)])
    assert refused.exit_code != 0
    assert "has the same map" in str(refused.exception or refused.output)


def test_held_out_dives_have_names_of_their_own(tmp_path: Path) -> None:
    one, other, wide = tmp_path / "a" / "reef", tmp_path / "b" / "reef", tmp_path / "wide"
    for seed, dive in enumerate((one, other, wide)):
        dive.parent.mkdir(exist_ok=True)
        small_dive(dive, seed)
    check_held_out([one], [other])
    with pytest.raises(InputError, match="'reef' like others"):
        check_held_out([one, other], [])
    with pytest.raises(InputError, match="'wide' like others"):
        check_held_out([wide], [])


@pytest.mark.usefixtures("small")
def test_a_run_from_weights_begins_with_their_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnx", reason="pip install 'aquaflow[export]'")
    monkeypatch.setattr(compact_run, "NetworkSize", NetworkSize)
    options = ["--scenes", "16", "--batch", "2", "--steps", "3", "--out", str(tmp_path)]
    command = ["lab", "prior", "train", "compact", *options, "--hours", "0"]
    result = CliRunner().invoke(cli.app, [*command, "--start", str(SHIPPED)])
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "history.json").read_text())
    assert [row["step"] for row in rows] == [0.0, 1.0]
    assert rows[0]["coarse_8px"] > 0.3


@pytest.mark.usefixtures("small")
def test_a_run_of_another_size_is_refused_the_checkpoint(tmp_path: Path) -> None:
    options = ["--scenes", "8", "--batch", "2", "--steps", "3", "--out", str(tmp_path)]
    command = ["lab", "prior", "train", "compact", *options, "--hours", "0"]
    assert CliRunner().invoke(cli.app, [*command, "--size", "4"]).exit_code == 0
    kept = load_checkpoint(tmp_path / "checkpoint.pt")
    assert kept.size == SMALL.times(4.0)
    assert CliRunner().invoke(cli.app, [*command, "--size", "4"]).exit_code == 0
    other = CliRunner().invoke(cli.app, command)
    assert "another network" in str(other.exception or other.output)


def test_processes_that_render_ahead_make_the_same_scenes(tmp_path: Path) -> None:
    one, other = (small_pool(tmp_path / name, 1) for name in ("one", "other"))
    with rendering_ahead(one, 2, 2):
        paths = [tmp_path / "one" / f"{one.name}_{shard:05d}.pt" for shard in range(2)]
        until = time.monotonic() + 120.0
        while not all(path.is_file() for path in paths) and time.monotonic() < until:
            time.sleep(0.1)
    for shard, path in enumerate(paths):
        other.ensure(shard)
        assert path.read_bytes() == (tmp_path / "other" / path.name).read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_the_command_trains_exports_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="pip install 'aquaflow[prior]'")
    pytest.importorskip("onnxscript", reason="pip install 'aquaflow[export]'")
    options = ["--scenes", "16", "--batch", "2", "--out", str(tmp_path), "--json"]
    command = ["lab", "prior", "train", "compact", *options]
    first = CliRunner().invoke(cli.app, [*command, "--steps", "2"])
    assert first.exit_code == 0, first.output
    card = read_card(tmp_path / compact_run.PRIOR)
    assert card.training is not None
    assert json.loads(first.stdout) == card.training
    assert max(card.parity.values()) <= 1e-4
    assert set(card.training["figures"]) == {"wide", "wider", "hard"}
    assert card.range_variance_factor >= LEAST_FACTOR
    again = CliRunner().invoke(cli.app, [*command, "--steps", "3"])
    assert json.loads(again.stdout)["steps"] == 3

    rows = json.loads((tmp_path / "history.json").read_text())
    assert [row["step"] for row in rows] == [1.0, 2.0, 3.0]
