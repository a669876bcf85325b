"""Fine-tuning as in the paper, with the tiny network: it learns, resumes, and shares its work."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from aquaflow import cli
from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.lab.networks.mast3r import export as weights
from aquaflow.lab.networks.mast3r.network import TINY, Mast3r
from aquaflow.lab.training import finetune
from aquaflow.lab.training import trainer as processes
from aquaflow.lab.training.datasets.posed import Frames
from aquaflow.lab.training.finetune import (
    HELD_OUT,
    BalancedOrder,
    FineTuning,
    FineTuningSettings,
    epoch_counts,
    mine_pairs,
    mirror,
    plan_of,
    read_data,
    recolour,
    vary,
)
from aquaflow.lab.training.mining import MinedPairs, PairIndex
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pairs import Pair, correspondences, nearest_pixels, true_pointmaps
from aquaflow.lab.training.trainer import (
    CHECKPOINT,
    HISTORY,
    DistributedProcess,
    TrainingProcess,
    _step,
)
from tests.lab.training.data_trees import write_colmap, write_tartanair
from tests.small_recording import GIVE_UP_S

pytestmark = pytest.mark.usefixtures("one_thread")


SMALL = FineTuningSettings(
    width=32, height=32, epochs=2, warm_up_epochs=1, batch=2, effective_batch=4
)


def silent(stage: str, done: int, total: int) -> None:
    """No progress bar."""


def tiny() -> Mast3r:
    torch.manual_seed(0)
    return Mast3r(TINY)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("tartanair")
    write_tartanair(root, count=7)
    return root


@pytest.fixture
def pairs(data: Path, tmp_path: Path) -> MinedPairs:
    return mine_pairs(
        read_data([f"tartanair={data}"]), tmp_path / "index", SMALL, TrainingProcess(), silent
    )


def test_the_papers_schedule_follows_from_the_number_of_pairs() -> None:
    """224,273 pairs, batches of 2 on 16 GPUs, 4 batches a step, 30 epochs of which 4 warm-up."""
    settings = FineTuningSettings()
    plan = plan_of(224_273 // settings.batch, settings)
    assert plan.batches == 16 * 4
    assert plan.betas == (0.9, 0.95)
    assert plan.schedule.warm_up == 4 * 1752
    assert plan.schedule.steps == 30 * 1752
    assert max(map(plan.schedule.rate, range(0, 30 * 1752, 97))) == pytest.approx(1e-6, rel=1e-3)
    assert plan.schedule.rate(30 * 1752 - 1) == pytest.approx(1e-7)


def test_the_loss_is_the_papers(pairs: MinedPairs) -> None:
    task = FineTuning(tiny(), pairs, SMALL, TrainingProcess())
    total, terms = task.loss(0)
    assert float(total.detach()) == pytest.approx(terms["points"] + 0.075 * terms["match"])


def test_points_stay_metric(pairs: MinedPairs) -> None:
    """The same scene twice as large is another truth: no scale is normalised away."""
    task = FineTuning(tiny(), pairs, SMALL, TrainingProcess())
    pair = pairs.pair([0])
    X = torch.cat([pair.a.points(), 2.0 * pair.a.points()])
    assert float(X[1].norm()) == pytest.approx(2.0 * float(X[0].norm()))
    assert task.loss(0)[1]["points"] > 1.0  # a network that knows nothing is metres off


def test_an_epoch_shows_every_pair_once_in_an_order_of_its_own(pairs: MinedPairs) -> None:
    task = FineTuning(tiny(), pairs, SMALL, TrainingProcess())
    epoch = [n for batch in range(task.batches_per_epoch) for n in task.numbers(batch)]
    assert len(epoch) == len(set(epoch)) == len(pairs) // 2 * 2
    again = [n for batch in range(task.batches_per_epoch) for n in
             task.numbers(task.batches_per_epoch + batch)]  # fmt: skip
    assert again != epoch


def test_no_picture_of_a_held_out_pair_is_trained_on() -> None:
    """One scene of 4,000 pictures, and 200 of two pictures each."""
    index = [PairIndex(0, a, a + gap, 0.5) for a in range(3_945) for gap in (1, 8, 55)]
    index += [PairIndex(scene, 0, 1, 0.5) for scene in range(1, 201)]
    scenes = [Frames(str(n), (), "tartanair" if n == 0 else "uwstereo") for n in range(201)]
    task = FineTuning(tiny(), MinedPairs(scenes, index, 32, 32), SMALL, TrainingProcess())

    def pictures(numbers: Iterable[int]) -> set[tuple[int, int]]:
        found = [index[n] for n in numbers]
        return {(pair.sequence, picture) for pair in found for picture in (pair.a, pair.b)}

    trained = [n for kind in task._order._by_kind.values() for n in kind]
    assert HELD_OUT / 2 < len(task._held_out) <= HELD_OUT
    assert {scenes[index[n].sequence].kind for n in task._held_out} == {"tartanair", "uwstereo"}
    assert not pictures(trained) & pictures(task._held_out)
    assert len(trained) > 0.95 * len(index)


def test_an_epoch_takes_from_each_data_set_as_the_paper_does() -> None:
    paper = {"tartanair": 76_387, "mimir": 44_721, "uwstereo": 26_611, "flsea": 6_576,
             "colmap": 69_978}  # fmt: skip
    assert sum(paper.values()) == 224_273
    assert epoch_counts(paper) == paper
    assert epoch_counts({kind: 3 * count for kind, count in paper.items()}) == paper
    few = epoch_counts({"tartanair": 2_000, "flsea": 900})
    assert sum(few.values()) == pytest.approx(2_900, abs=1)
    assert few["tartanair"] / few["flsea"] == pytest.approx(76_387 / 6_576, rel=0.01)


def test_no_pair_of_a_set_is_shown_twice_as_often_as_another() -> None:
    """One set has four times its share, the other a quarter of it."""
    sets = {"tartanair": range(40), "mimir": range(40, 45), "colmap": range(45, 65)}
    order = BalancedOrder(sets, seed=3)
    shown = Counter(n for epoch in range(12) for n in order.epoch(epoch))
    assert shown.total() == 12 * order.length
    for numbers in sets.values():
        times = [shown[n] for n in numbers]
        assert max(times) - min(times) <= 1
    assert order.epoch(5) == BalancedOrder(sets, seed=3).epoch(5)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_a_step_is_the_same_on_any_number_of_processes(pairs: MinedPairs, count: int) -> None:
    """Five processes have four batches between them: one has none."""
    settings = replace(SMALL, effective_batch=8)
    plan = plan_of(1, settings)
    assert plan.batches == 4

    class Share(TrainingProcess):
        """Adds nothing up; keeps what it would have added."""

        def __init__(self, rank: int, count: int) -> None:
            self.rank, self.count = rank, count

        def add_up(self, parameters: Iterable[torch.Tensor]) -> None:
            self.found = [torch.zeros_like(x) if x.grad is None else x.grad for x in parameters]

    def gradient(rank: int, count: int) -> list[torch.Tensor]:
        process = Share(rank, count)
        task = FineTuning(tiny(), pairs, settings, process)
        still = torch.optim.SGD(task.network.parameters(), lr=0.0)
        # Cut to a length after the processes were added up, in place: none is so long here.
        _step(task, still, replace(plan, longest_gradient=math.inf), 0, process)
        return process.found

    alone = gradient(0, 1)
    shares = [gradient(rank, count) for rank in range(count)]
    for whole, *parts in zip(alone, *shares, strict=True):
        torch.testing.assert_close(torch.stack(parts).sum(0), whole, rtol=1e-3, atol=1e-6)


def test_batches_that_do_not_come_out_even_are_refused() -> None:
    with pytest.raises(ArgumentError, match="cut into batches of 3; give a --batch"):
        FineTuningSettings(batch=3)


def test_too_few_pairs_are_refused(pairs: MinedPairs) -> None:
    few = MinedPairs(pairs.scenes, pairs.index[:1], 32, 32)
    with pytest.raises(InputError, match="give more --data"):
        FineTuning(tiny(), few, SMALL, TrainingProcess())


@pytest.mark.parametrize("zoom", [1.0, 1.25])
def test_a_varied_pair_has_the_matches_of_its_scene(pairs: MinedPairs, zoom: float) -> None:
    """Where both views show one point of the plane, they show one colour of its pattern."""
    plain = pairs.pair([0, 3], torch.tensor([[1.0, zoom], [zoom, 1.0]]))
    for pair in (plain, Pair(mirror(plain.a), mirror(plain.b))):
        found = correspondences(pair)
        assert float(found.visible.float().mean()) > 0.3
        rows, columns = nearest_pixels(found.pixels, pair.b)
        batch = torch.arange(2)[:, None, None]
        off = (pair.a.image - pair.b.image[batch, :, rows, columns].permute(0, 3, 1, 2)).abs()
        elsewhere = (pair.a.image - pair.b.image).abs()
        assert float(off.mean(1)[found.visible].mean()) < 0.5 * float(elsewhere.mean())


def test_a_mirror_image_keeps_every_distance(pairs: MinedPairs) -> None:
    pair = pairs.pair([1])
    X_a, X_b = true_pointmaps(pair)
    found = true_pointmaps(Pair(mirror(pair.a), mirror(pair.b)))
    flip = torch.tensor([-1.0, 1.0, 1.0])
    for X, mirrored in zip((X_a, X_b), found, strict=True):
        torch.testing.assert_close(mirrored, (flip * X).flip(2), rtol=1e-4, atol=1e-4)


def test_colours_vary_by_view_and_depths_do_not(pairs: MinedPairs) -> None:
    pair = pairs.pair([0, 1])
    image = recolour(Draw(5), pair.a.image)
    assert bool(((image >= 0.0) & (image <= 1.0)).all())
    factors = image.mean((2, 3)) / pair.a.image.mean((2, 3))
    assert float((factors[0] - factors[1]).abs().max()) > 0.02
    varied = vary(Draw(5), pair)
    assert sorted(float(v.depth.sum()) for v in (varied.a, varied.b)) == pytest.approx(
        sorted(float(v.depth.sum()) for v in (pair.a, pair.b))
    )
    same = vary(Draw(5), pair)
    assert torch.equal(varied.a.image, same.a.image)


def test_only_training_is_varied(pairs: MinedPairs, monkeypatch: pytest.MonkeyPatch) -> None:
    task = FineTuning(tiny(), pairs, SMALL, TrainingProcess())
    task._held_out = [0, 1]
    before, first = task.validate(), task.loss(0)[1]
    monkeypatch.setattr(finetune, "vary", lambda draw, pair: pair)
    assert task.validate() == before
    assert task.loss(0)[1] != first


def test_pictures_that_never_overlap_are_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path / "set", count=1)
    sequences = read_data([f"colmap={tmp_path / 'set'}"])
    with pytest.raises(InputError, match="overlap by 30 %"):
        mine_pairs(sequences, tmp_path / "out", SMALL, TrainingProcess(), silent)


@pytest.mark.parametrize("spec", ["tartanair", "kitti=/data", "=/data", ""])
def test_a_data_set_that_is_not_known_is_refused(spec: str) -> None:
    with pytest.raises(ArgumentError, match="give KIND=FOLDER"):
        read_data([spec])


@pytest.fixture
def tiny_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkpoint of the tiny network, which the command takes for the full one."""
    path = tmp_path / "tiny.pth"
    torch.save({"model": tiny().state_dict()}, path)
    load = weights.load_checkpoint
    monkeypatch.setattr(weights, "load_checkpoint", lambda path: load(path, TINY))
    return path


def test_the_command_trains_and_writes_weights_that_export_reads(
    data: Path, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = ["lab", "prior", "train", "mast3r", "--checkpoint", tiny_checkpoint, "--out", out,
                 "--data", f"tartanair={data}", "--width", 32, "--height", 32, "--epochs", 1,
                 "--effective-batch", 4]  # fmt: skip
    result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    assert "not for commercial use" in result.output
    trained = weights.load_checkpoint(out / finetune.WEIGHTS).state_dict()
    changed = [name for name, x in tiny().state_dict().items() if not torch.equal(x, trained[name])]
    assert "enc_blocks.0.attn.qkv.weight" in changed
    assert "downstream_head1.dpt.head.4.weight" in changed


WORKER = """
import sys
from pathlib import Path
import torch
from aquaflow.lab.networks.mast3r.network import Mast3r
from aquaflow.lab.networks.mast3r.network import TINY
from aquaflow.lab.training import finetune
from aquaflow.lab.training.trainer import joined_processes
from aquaflow.lab.training.trainer import Schedule
from aquaflow.lab.training.trainer import TrainingPlan

torch.set_num_threads(1)
data, out = sys.argv[1], Path(sys.argv[2])
settings = finetune.FineTuningSettings(32, 32, 1, 1, batch=1, effective_batch=4)
finetune.plan_of = lambda batches, settings: TrainingPlan(
    Schedule(2, 1, 1e-3, 1e-4), batches=4
)
torch.manual_seed(0)
network = Mast3r(TINY)
with joined_processes() as process:
    pairs = finetune.mine_pairs(
        finetune.read_data([f"tartanair={data}"]), out, settings, process, lambda *_: None
    )
    finetune.fine_tune(network, pairs, out, settings, process, lambda *_: None)
    torch.save(network.state_dict(), out / f"rank{process.rank}.pt")
"""


@pytest.mark.slow
def test_two_processes_train_one_network(data: Path, tmp_path: Path) -> None:
    """Each sees pairs of its own, and both end with the same weights."""
    script, out = tmp_path / "worker.py", tmp_path / "out"
    script.write_text(WORKER)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    workers = []
    for rank in ("0", "1"):  # as torchrun sets it, whose own process would import torch once more
        told = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2"}
        told |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        command = [sys.executable, str(script), str(data), str(out)]
        workers.append(
            subprocess.Popen(command, env={**os.environ, **told}, stderr=subprocess.PIPE, text=True)
        )
    for worker in workers:
        _, said = worker.communicate(timeout=GIVE_UP_S)
        assert worker.returncode == 0, said[-2000:]
    first, second = (torch.load(out / f"rank{rank}.pt") for rank in (0, 1))
    assert all(torch.equal(first[name], second[name]) for name in first)
    start = tiny().state_dict()
    assert not torch.equal(first["enc_blocks.0.attn.qkv.weight"], start[
        "enc_blocks.0.attn.qkv.weight"
    ])  # fmt: skip
    written = torch.load(out / finetune.WEIGHTS)["model"]
    assert all(torch.equal(written[name], first[name]) for name in first)


def torchrun(out: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A run of two processes, all of which end with it, whatever happens."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node"]
    command += ["2", "-m", "tests.lab.training.generated_run", str(out), "--tiny", "--steps", "24"]
    command += ["--pairs", "104", "--save-every", "6", *arguments]
    with subprocess.Popen(
        command,
        cwd=Path(__file__).parents[3],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as run:
        try:
            _, said = run.communicate(timeout=GIVE_UP_S)
        except BaseException:
            os.killpg(run.pid, signal.SIGKILL)
            raise
    return subprocess.CompletedProcess(command, run.returncode, "", said)


@pytest.mark.slow
def test_training_learns_and_one_that_was_killed_goes_on_as_if_it_had_not_been(
    tmp_path: Path,
) -> None:
    """From random weights, on generated pairs; a process is killed between two checkpoints."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run = torchrun(whole)
    assert run.returncode == 0, run.stderr[-2000:]
    rows = json.loads((whole / HISTORY).read_text())
    assert [row["step"] for row in rows] == [6, 12, 18, 24]
    for name in ("loss_points", "loss_match", "held_out_points", "held_out_match"):
        assert rows[-1][name] < 0.8 * rows[0][name], name

    shutil.copytree(whole / "pool", killed / "pool")
    assert torchrun(killed, "--die-at", "15").returncode != 0
    assert torch.load(killed / CHECKPOINT)["step"] == 12
    run = torchrun(killed)
    assert run.returncode == 0, run.stderr[-2000:]
    resumed = json.loads((killed / HISTORY).read_text())
    for row in (*rows, *resumed):
        del row["cpu_s"]
    assert resumed == rows
    names = [f"rank{rank}_{finetune.WEIGHTS}" for rank in (0, 1)]
    first, *others = (torch.load(out / name) for out in (whole, killed) for name in names)
    assert all(torch.equal(first[name], other[name]) for other in others for name in first)


def test_gradients_become_their_sum_over_the_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The other process has gradient 3 everywhere; no gradient here counts as zero."""
    one = DistributedProcess.__new__(DistributedProcess)
    monkeypatch.setattr(processes.dist, "all_reduce", lambda tensor: tensor.add_(3.0))
    known, unknown, fixed = (torch.nn.Parameter(torch.zeros(2)) for _ in range(3))
    known.grad = torch.ones(2)
    fixed.requires_grad_(False)
    one.add_up([known, unknown, fixed])
    torch.testing.assert_close(known.grad, torch.full((2,), 4.0))
    torch.testing.assert_close(unknown.grad, torch.full((2,), 3.0))
    assert fixed.grad is None
