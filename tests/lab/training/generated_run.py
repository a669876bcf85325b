"""Fine-tuning from random weights on generated pairs, in the processes that torchrun starts.

    torchrun --standalone --nproc-per-node 2 -m tests.lab.training.generated_run OUT --steps 3000

Given once more, it goes on from OUT's checkpoint. ``--die-at`` kills the last process, to try that.
"""

from __future__ import annotations

import argparse
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from aquaflow.lab.networks.mast3r.network import TINY, Mast3r, Mast3rSize
from aquaflow.lab.training.finetune import WEIGHTS, FineTuning, FineTuningSettings
from aquaflow.lab.training.mining import PairIndex
from aquaflow.lab.training.pair_generator.drawing import through_water, turned_view
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.scene import Detail
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD, Pool
from aquaflow.lab.training.pairs import Pair, ViewBatch, join
from aquaflow.lab.training.trainer import Schedule, TrainingPlan, joined_processes, train

SMALL = Mast3rSize(
    encoder_depth=4,
    encoder_width=128,
    encoder_heads=4,
    decoder_depth=4,
    decoder_width=96,
    decoder_heads=3,
    level_widths=(16, 24, 32, 48),
    fused_width=32,
    head_width=16,
    descriptor=16,
)
"""11 million numbers: what an hour of two CPU cores can move."""
WIDTH, HEIGHT = 64, 48
"""px of the pictures: a pair's matches, each compared with all others, cost most."""


@dataclass(frozen=True)
class GeneratedPairs:
    """The first ``count`` pairs of a pool, each in a water of its own."""

    pool: Pool
    count: int

    @property
    def index(self) -> list[PairIndex]:
        return [PairIndex(number, 0, 1, 1.0) for number in range(self.count)]

    @property
    def kinds(self) -> list[str]:
        return ["generated"] * self.count

    def pair(self, numbers: Sequence[int], zooms: Tensor | None = None) -> Pair:
        factors = torch.ones(len(numbers), 2) if zooms is None else zooms
        return join([self._one(n, *z) for n, z in zip(numbers, factors.tolist(), strict=True)])

    def _one(self, number: int, zoom_a: float, zoom_b: float) -> Pair:
        pair = through_water(Draw(number), self.pool.pairs(torch.tensor([number])))
        return Pair(_zoomed(pair.a, zoom_a), _zoomed(pair.b, zoom_b))


def _zoomed(view: ViewBatch, zoom: float) -> ViewBatch:
    height, width = view.depth.shape[-2:]
    K = view.K.clone()
    K[:, :2, :2] *= zoom
    return turned_view(view, K, torch.eye(3)[None], width, height)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--pairs", type=int, default=800)
    parser.add_argument("--save-every", type=int, default=100)
    parser.add_argument("--tiny", action="store_true")
    parser.add_argument("--die-at", type=int)
    told = parser.parse_args()

    torch.set_num_threads(1)
    torch.manual_seed(0)
    network = Mast3r(TINY if told.tiny else SMALL)
    detail = Detail(64, 128) if told.tiny else Detail()
    pool = Pool(told.out / "pool", 1, WIDTH, HEIGHT, detail=detail)
    settings = FineTuningSettings(WIDTH, HEIGHT, batch=4, effective_batch=16)
    schedule = Schedule(told.steps, told.steps // 10, 1e-3, 1e-5)
    every = told.save_every
    plan = TrainingPlan(schedule, settings.batches, validate_every=every, save_every=every)

    with joined_processes() as process:
        if process.leads:
            for shard in range(-(-told.pairs // SHARD)):
                pool.ensure(shard)
        process.wait()

        def advance(stage: str, done: int, total: int) -> None:
            if process.rank == process.count - 1 and done == told.die_at:
                os.kill(os.getpid(), signal.SIGKILL)

        task = FineTuning(network, GeneratedPairs(pool, told.pairs), settings, process)
        train(task, plan, told.out, advance, process)
        torch.save(network.state_dict(), told.out / f"rank{process.rank}_{WEIGHTS}")


if __name__ == "__main__":
    main()
