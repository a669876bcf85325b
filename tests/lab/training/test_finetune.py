"""Fine-tuning as in the paper, with the tiny network: it learns, resumes, and shares its work."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from aquaflow import cli
from aquaflow.base.errors import InputError
from aquaflow.lab.networks.mast3r import export as weights
from aquaflow.lab.networks.mast3r.network import TINY, Mast3r
from aquaflow.lab.training import finetune
from aquaflow.lab.training import trainer as processes
from aquaflow.lab.training.finetune import (
    FineTuning,
    FineTuningSettings,
    mine_pairs,
    plan_of,
    read_data,
)
from aquaflow.lab.training.mining import MinedPairs
from aquaflow.lab.training.trainer import DistributedProcess, TrainingProcess
from tests.lab.training.data_trees import write_colmap, write_tartanair
from tests.small_recording import GIVE_UP_S

pytestmark = pytest.mark.usefixtures("one_thread")


SMALL = FineTuningSettings(width=32, height=32, epochs=2, warm_up_epochs=1, batch=2, accumulate=2)


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
    plan = plan_of(224_273 // (16 * settings.batch), settings)
    assert plan.accumulate == 4
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


def test_an_epoch_shows_every_pair_once_to_one_process(pairs: MinedPairs) -> None:
    def processes(count: int) -> list[FineTuning]:
        tasks = []
        for rank in range(count):
            one = TrainingProcess()
            one.rank, one.count = rank, count
            tasks.append(FineTuning(tiny(), pairs, SMALL, one))
        return tasks

    tasks = processes(2)
    seen = [n for task in tasks for step in range(task.batches_per_epoch)
            for n in task._numbers(step)]  # fmt: skip
    assert len(seen) == len(set(seen)) >= len(pairs) - 4
    again = [tasks[0]._numbers(tasks[0].batches_per_epoch + step) for step in range(2)]
    assert again != [tasks[0]._numbers(step) for step in range(2)]


def test_too_few_pairs_are_refused(pairs: MinedPairs) -> None:
    few = MinedPairs(pairs.scenes, pairs.index[:1], 32, 32)
    with pytest.raises(InputError, match="give more --data"):
        FineTuning(tiny(), few, SMALL, TrainingProcess())


def test_pictures_that_never_overlap_are_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path / "set", count=1)
    sequences = read_data([f"colmap={tmp_path / 'set'}"])
    with pytest.raises(InputError, match="overlap by 30 %"):
        mine_pairs(sequences, tmp_path / "out", SMALL, TrainingProcess(), silent)


@pytest.mark.parametrize("spec", ["tartanair", "kitti=/data", "=/data", ""])
def test_a_data_set_that_is_not_known_is_refused(spec: str) -> None:
    with pytest.raises(InputError, match="give KIND=FOLDER"):
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
                 "--accumulate", 2]  # fmt: skip
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
settings = finetune.FineTuningSettings(32, 32, 1, 1, batch=1, accumulate=2)
finetune.plan_of = lambda batches, settings: TrainingPlan(
    Schedule(2, 1, 1e-3, 1e-4), accumulate=2
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


def test_gradients_become_their_mean_over_the_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The other process has gradient 3 everywhere; no gradient here counts as zero."""
    one = DistributedProcess.__new__(DistributedProcess)
    one.count = 2
    monkeypatch.setattr(processes.dist, "all_reduce", lambda tensor: tensor.add_(3.0))
    known, unknown, fixed = (torch.nn.Parameter(torch.zeros(2)) for _ in range(3))
    known.grad = torch.ones(2)
    fixed.requires_grad_(False)
    one.average([known, unknown, fixed])
    torch.testing.assert_close(known.grad, torch.full((2,), 2.0))
    torch.testing.assert_close(unknown.grad, torch.full((2,), 1.5))
    assert fixed.grad is None
