"""The compact prior learns, a run resumes where it stopped, and what it learns from is fixed."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from aquaflow.base.errors import InputError
from aquaflow.lab.networks.compact.network import COARSE, CompactPrior, NetworkSize
from aquaflow.lab.training import compact
from aquaflow.lab.training.compact import CompactSettings, CompactTask, coarse_loss, compact_losses
from aquaflow.lab.training.compact_recall import mean_recall
from aquaflow.lab.training.pair_generator.cameras import TRAINING
from aquaflow.lab.training.pair_generator.drawing import WindowVariation, training_pair
from aquaflow.lab.training.pair_generator.map_pairs import MapPairs
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.real_pictures import RealPictures
from aquaflow.lab.training.pair_generator.render import render_pairs
from aquaflow.lab.training.pair_generator.scene import Detail
from aquaflow.lab.training.pair_generator.stored_pairs import Pool
from aquaflow.lab.training.pairs import Correspondences, Pair
from aquaflow.lab.training.trainer import (
    CHECKPOINT,
    CURVE,
    HISTORY,
    Schedule,
    TrainingPlan,
    has_ended,
    train,
)
from tests.lab.training.small_maps import small_dive

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = NetworkSize(levels=(8, 8, 12, 16), merged=(16, 12, 8), fine=8, coarse=16, head=4)
DETAIL = Detail(terrain=64, texture=128)
LOOKS = WindowVariation(width=64, height=48, roll=0.2)
SETTINGS = CompactSettings(batch=2, matches=64, first_scenes=8, steps_per_shard=2, scenes=24)
PLAN = TrainingPlan(Schedule(4, 1, 1e-3, 1e-4), validate_every=2, save_every=2)


def silent(stage: str, done: int, total: int) -> None:
    """No progress bar."""


def network() -> CompactPrior:
    torch.manual_seed(0)
    return CompactPrior(SMALL)


@pytest.fixture(scope="module")
def pair() -> Pair:
    draw = Draw(2)
    clear = render_pairs(draw, 2, 96, 72, TRAINING, DETAIL)
    return training_pair(draw, clear, LOOKS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pool")


def task(folder: Path) -> CompactTask:
    pool = Pool(folder, 1, 48, 36, detail=DETAIL)
    looks = replace(LOOKS, width=32, height=32)
    return CompactTask(network(), pool, {}, SETTINGS, lambda step: looks, 1)


class Recorded(CompactTask):
    """A task without held-out pairs, whose figure is known."""

    def validate(self) -> dict[str, float]:
        return {"figure": 0.5}


def recorded(folder: Path) -> Recorded:
    return Recorded(**vars(task(folder)))


@pytest.fixture(scope="module")
def whole(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Recorded, Path]:
    """A run that nothing stopped, and its folder; only read."""
    ended, out = recorded(folder), tmp_path_factory.mktemp("whole")
    train(ended, PLAN, out, silent)
    return ended, out


def test_one_pair_is_learnt_by_heart(pair: Pair) -> None:
    prior = network()
    optimiser = torch.optim.AdamW(prior.parameters(), lr=4e-3)

    def recall() -> float:
        prior.eval()
        return mean_recall(prior.encode, prior.comparison, [pair])["fine_4px"]

    before = recall()
    for step in range(40):
        prior.train()
        terms = compact_losses(prior, pair, SETTINGS, Draw(step))
        optimiser.zero_grad()
        sum(terms.values(), torch.zeros(())).backward()
        optimiser.step()
    assert before < 0.3
    assert recall() > before + 0.4


def test_every_term_reaches_the_weights_it_is_for(pair: Pair) -> None:
    prior = network()
    reached = {}
    for name in ("coarse", "among", "around", "trust", "range"):
        prior.zero_grad()
        compact_losses(prior, pair, SETTINGS, Draw(0))[name].backward()
        reached[name] = {key for key, p in prior.named_parameters() if p.grad is not None}
    assert any(key.startswith("encoder.down_2") for key in reached["coarse"] & reached["around"])
    assert reached["trust"] == {"encoder.trust.weight", "encoder.trust.bias"}
    assert all(key.startswith("comparison.range") for key in reached["range"])


def test_coarse_loss_is_chance_for_equal_cells_and_little_for_the_right_ones() -> None:
    rows, columns = 4, 6
    centres = torch.meshgrid(
        torch.arange(rows * COARSE) + 0.5, torch.arange(columns * COARSE) + 0.5, indexing="ij"
    )
    pixels = torch.stack([centres[1], centres[0]], -1)[None]
    found = Correspondences(pixels, torch.ones(1, rows * COARSE, columns * COARSE).bool())
    size = (rows * COARSE, columns * COARSE)
    cells = rows * columns
    chance = coarse_loss(torch.zeros(1, cells, cells), found, size)
    right = coarse_loss(20.0 * torch.eye(cells)[None], found, size)
    assert float(chance) == pytest.approx(math.log(cells), rel=1e-4)
    assert float(right) < 1e-3


def test_a_pair_that_shares_nothing_costs_nothing_and_can_be_differentiated(pair: Pair) -> None:
    T = pair.b.T_wc.clone()
    T[:, :3, 3] += 1000.0
    apart = Pair(pair.a, replace(pair.b, T_wc=T))
    terms = compact_losses(network(), apart, SETTINGS, Draw(0))
    matching = terms["coarse"] + terms["among"] + terms["around"] + terms["trust"]
    matching.backward()
    assert float(matching.detach()) == 0.0


def test_early_steps_use_the_first_scenes_only(folder: Path) -> None:
    learner = task(folder)
    asked: list[Tensor] = []
    pairs = learner.pool.pairs
    learner.pool.pairs = lambda numbers: asked.append(numbers) or pairs(numbers)  # type: ignore
    for step in (0, 1, 40):
        learner.loss(step)
    assert int(torch.stack(asked[:2]).max()) < SETTINGS.first_scenes
    assert int(torch.stack(asked).max()) < SETTINGS.scenes


def test_a_run_that_was_stopped_ends_with_the_same_weights(
    whole: tuple[Recorded, Path], folder: Path, tmp_path: Path
) -> None:
    ended, parts = whole[0], recorded(folder)
    history = json.loads((whole[1] / HISTORY).read_text())

    def stops(stage: str, done: int, total: int) -> None:
        if done == 3:  # after the checkpoint of step 2
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(parts, PLAN, tmp_path / "parts", stops)
    resumed = recorded(folder)
    again = train(resumed, PLAN, tmp_path / "parts", silent)
    for one, other in zip(
        ended.network.state_dict().values(), resumed.network.state_dict().values(), strict=True
    ):
        assert torch.equal(one, other)
    assert [row["loss_coarse"] for row in again] == [row["loss_coarse"] for row in history]


def test_hours_stop_a_run_that_then_goes_on_to_the_same_weights(
    whole: tuple[Recorded, Path], folder: Path, tmp_path: Path
) -> None:
    calls = 0
    while True:
        part = recorded(folder)
        history = train(part, replace(PLAN, hours=0.0), tmp_path / "parts", silent)
        calls += 1
        if has_ended(history, PLAN.schedule):
            break
    assert calls == PLAN.schedule.steps
    for one, other in zip(
        whole[0].network.state_dict().values(), part.network.state_dict().values(), strict=True
    ):
        assert torch.equal(one, other)


def test_real_pictures_join_a_batch(folder: Path, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (36, 48, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    learner = task(folder)
    plain = learner.loss(0)[1]
    learner.real = RealPictures([tmp_path], 48, 36)
    learner.settings = replace(SETTINGS, real_share=0.5)
    assert learner.loss(0)[1]["coarse"] != plain["coarse"]


def with_maps(folder: Path, dive: Path, first_step: int) -> Recorded:
    """A task whose batches are a quarter pairs of a map, from ``first_step`` on."""
    learner = recorded(folder)
    learner.settings = replace(SETTINGS, batch=4)
    learner.maps = MapPairs([dive], folder, 1, 48, 36, count=8)
    learner.maps_from = first_step
    return learner


def test_a_run_may_be_given_its_maps_when_they_take_part(folder: Path, tmp_path: Path) -> None:
    dive = small_dive(tmp_path / "dive", kept=4)
    whole = with_maps(folder, dive, 2)
    train(whole, PLAN, tmp_path / "whole", silent)
    for _ in range(2):
        before = with_maps(folder, dive, 2)
        before.maps = None
        train(before, replace(PLAN, hours=0.0), tmp_path / "parts", silent)
    resumed, without = with_maps(folder, dive, 2), with_maps(folder, dive, 4)
    shutil.copytree(tmp_path / "parts", tmp_path / "without")
    train(resumed, PLAN, tmp_path / "parts", silent)
    train(without, PLAN, tmp_path / "without", silent)
    weights = [list(each.network.state_dict().values()) for each in (whole, resumed, without)]
    assert all(map(torch.equal, weights[0], weights[1]))
    assert not all(map(torch.equal, weights[0], weights[2]))


@pytest.mark.parametrize(
    ("says", "multiplies"),
    [("flags : avx2 avx512_bf16", True), ("Features : asimd bf16", True), ("flags : avx2", False)],
)
def test_bfloat16_is_used_where_the_processor_has_it(
    says: str, multiplies: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compact, "CPUINFO", tmp_path / "cpuinfo")
    multiplies_here = compact.multiplies_bfloat16.__wrapped__
    assert not multiplies_here(torch.device("cpu"))
    (tmp_path / "cpuinfo").write_text(says)
    assert multiplies_here(torch.device("cpu")) == multiplies


def test_every_held_out_dive_has_figures_of_its_own(folder: Path, pair: Pair) -> None:
    learner = task(folder)
    learner.held_out = {"": [pair], "iui3_": [pair.swap()]}
    figures = learner.validate()
    names = {name for name in figures if not name.startswith("iui3_")}
    assert {"fine_2px", "log_range"} <= names
    assert set(figures) == names | {f"iui3_{name}" for name in names}
    assert any(figures[name] != figures[f"iui3_{name}"] for name in names)


def test_the_smallest_batch_has_a_pair_of_a_map(folder: Path, tmp_path: Path) -> None:
    learner = with_maps(folder, small_dive(tmp_path / "dive"), 1)
    learner.settings = SETTINGS
    plain, early = recorded(folder), learner.loss(0)[1]
    assert early == plain.loss(0)[1]
    assert learner.loss(1)[1]["coarse"] != plain.loss(1)[1]["coarse"]


def test_ranges_are_learnt_from_maps_and_not_from_pictures(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (36, 48, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    learner = with_maps(folder, small_dive(tmp_path / "dive"), 0)
    learner.real = RealPictures([tmp_path], 48, 36)
    seen: list[Tensor] = []

    def losses(
        network: CompactPrior,
        pair: Pair,
        settings: CompactSettings,
        draw: Draw,
        ranged: Tensor,  # [B] bool
    ) -> dict[str, Tensor]:
        seen.append(ranged)
        return compact_losses(network, pair, settings, draw, ranged)

    monkeypatch.setattr(compact, "compact_losses", losses)
    learner.loss(0)
    assert seen[0].tolist() == [True, True, True, False]


def test_a_run_leaves_a_curve_and_its_figures(whole: tuple[Recorded, Path]) -> None:
    rows = json.loads((whole[1] / HISTORY).read_text())
    assert [row["step"] for row in rows] == [2.0, 4.0]
    assert rows[-1]["figure"] == 0.5
    assert (whole[1] / CURVE).read_bytes().startswith(b"\x89PNG")


def test_the_checkpoint_of_another_network_is_refused(folder: Path, tmp_path: Path) -> None:
    train(recorded(folder), replace(PLAN, schedule=Schedule(1, 1)), tmp_path, silent)
    other = recorded(folder)
    other.network = CompactPrior(replace(SMALL, coarse=20))
    with pytest.raises(InputError, match="another network"):
        train(other, PLAN, tmp_path, silent)
    assert (tmp_path / CHECKPOINT).is_file()


class Broken:
    """A task whose loss is no number."""

    def __init__(self) -> None:
        self.network = nn.Linear(2, 1)

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        return self.network(torch.full((1, 2), torch.inf)).sum() * 0.0, {"loss": math.nan}

    def validate(self) -> dict[str, float]:
        return {}


def test_a_loss_that_is_no_number_moves_nothing(tmp_path: Path) -> None:
    broken = Broken()
    before = broken.network.weight.detach().clone()
    train(broken, PLAN, tmp_path, silent)
    assert torch.equal(broken.network.weight, before)


def test_a_held_rate_stays_highest_and_then_falls_to_the_lowest() -> None:
    schedule = Schedule(100, 10, 1.0, 0.1, hold=50)
    assert [schedule.rate(step) for step in (9, 30, 60)] == [1.0, 1.0, 1.0]
    assert 0.1 < schedule.rate(80) < 1.0
    assert schedule.rate(99) == pytest.approx(0.1)
