"""`aquaflow prior train compact`: a pool of scenes, a training, and the folder that tracks."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from aquaflow.errors import InputError
from aquaflow.prior.compact.export import export, folded
from aquaflow.prior.compact.network import CompactPrior
from aquaflow.prior.compact.quantise import INT8_ENCODER
from aquaflow.prior.folder import ENCODER, PriorCard, write_card
from aquaflow.training.compact import CompactSettings, CompactTask
from aquaflow.training.compact_recall import SEED as HELD_OUT_SEED
from aquaflow.training.compact_recall import (
    held_out_pairs,
    mean_recall,
    onnx_encoder,
    tracked_recall,
)
from aquaflow.training.curve import NOT_FIGURES
from aquaflow.training.pair_generator.cameras import WIDER
from aquaflow.training.pair_generator.draw import Draw
from aquaflow.training.pair_generator.drawing import WindowVariation, through_water
from aquaflow.training.pair_generator.pool import SHARD, Pool
from aquaflow.training.pairs import Pair
from aquaflow.training.schedule import Schedule
from aquaflow.training.trainer import Progress, TrainingPlan, train

POOL, HELD_OUT, HELD_OUT_WIDER, PRIOR = "pool", "held_out", "held_out_wider", "prior"
"""Folders of a run: training pairs, two sets of held-out ones, the exported prior."""
CALIBRATION_SEED = 2000
"""Of the water over the pictures that 8-bit ranges are taken from."""
CALIBRATION_SHARDS = 2
"""Of the pool, 16 pairs: the pictures that the ranges are taken from."""


@dataclass(frozen=True)
class CompactRun:
    """All that a run's result follows from, together with the code."""

    seed: int = 1
    steps: int = 20_000
    hold: float = 0.7
    """Share of the steps at the highest rate; the rest anneals."""
    warm_up: int = 100
    rate: float = 2e-3
    lowest_rate: float = 2e-5
    settings: CompactSettings = field(default_factory=CompactSettings)
    looks: WindowVariation = field(default_factory=WindowVariation)

    @property
    def schedule(self) -> Schedule:
        """Warm-up, hold, half a cosine."""
        hold = round(self.hold * self.steps)
        return Schedule(self.steps, self.warm_up, self.rate, self.lowest_rate, hold)


def train_compact(run: CompactRun, out: Path, progress: Progress, device: str = "cpu") -> PriorCard:
    """Train on ``device`` in ``out``, continuing an earlier run there; export to ``out``/prior.

    Raises:
        InputError: ``out`` holds the checkpoint of another network, or there is no such device.
    """
    place = device_called(device)
    torch.manual_seed(run.seed)
    network = CompactPrior().to(place)
    pool = Pool(out / POOL, run.seed)
    first = -(-min(run.settings.first_scenes, run.settings.scenes) // SHARD)
    for shard in range(first):
        pool.ensure(shard)
        progress("scenes", shard + 1, first)
    held_out = held_out_pairs(out / HELD_OUT)
    task = CompactTask(network, pool, held_out, run.settings, run.looks, run.seed)
    history = train(task, TrainingPlan(run.schedule), out, progress)
    record = training_record(run, history, hardware_of(device))
    network = network.cpu()
    card = export(network, out / PRIOR, record, calibration(pool), progress)
    wider = held_out_pairs(out / HELD_OUT_WIDER, WIDER)
    return with_figures(out / PRIOR, card, network, {"wide": held_out, "wider": wider})


def device_called(name: str) -> torch.device:
    """cpu, cuda or cuda:N.

    Raises:
        InputError: torch knows no such device, or it is not here.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"there is no device '{name}'; give cpu or cuda") from error
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"training on '{name}' is not supported; give cpu or cuda")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(f"torch finds no GPU for device '{name}'; give cpu")
    return device


def training_record(
    run: CompactRun, history: list[dict[str, float]], hardware: str
) -> dict[str, Any]:
    """What prior.json keeps of a training."""
    return {
        "data": "generated pictures only (aquaflow.training.pair_generator)",
        "seed": run.seed,
        "pool_seed": run.seed,
        "held_out_seed": HELD_OUT_SEED,
        "steps": run.steps,
        "pairs": run.steps * run.settings.batch,
        "scenes": run.settings.scenes,
        "hardware": hardware,
        "torch": torch.__version__,
        "cpu_s": history[-1]["cpu_s"],
        "held_out": _rounded(
            {
                name: value
                for name, value in history[-1].items()
                if name not in NOT_FIGURES and not name.startswith("loss_")
            }
        ),
    }


def hardware_of(device: str) -> str:
    """What trains, in words."""
    if torch.device(device).type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, bfloat16"
    cores, threads = os.cpu_count(), torch.get_num_threads()
    return f"{platform.machine()} CPU, {threads} of {cores} cores, bfloat16"


def with_figures(
    folder: Path, card: PriorCard, network: CompactPrior, sets: dict[str, list[Pair]]
) -> PriorCard:
    """The card of ``folder``, extended by what its encoders find of several sets of pairs."""
    comparison = folded(network).comparison
    encoders = {"32_bit": ENCODER, "8_bit": INT8_ENCODER}
    figures: dict[str, Any] = {}
    for name, pairs in sets.items():
        alone = tracked_recall(None, pairs)["flow_2px"]
        figures[name] = {"pairs": sum(len(pair.a.K) for pair in pairs), "flow_alone_2px": alone}
        for bits, file in encoders.items():
            encode = onnx_encoder(folder / file)
            found = mean_recall(encode, comparison, pairs) | tracked_recall(encode, pairs)
            figures[name][bits] = _rounded(found)
    card = card.model_copy(update={"training": (card.training or {}) | {"figures": figures}})
    write_card(folder, card)
    return card


def calibration(pool: Pool) -> list[Any]:
    """[1, 3, H, W] pictures of the pool, through water, for the 8-bit encoder."""
    pairs = pool.pairs(torch.arange(CALIBRATION_SHARDS * SHARD))
    seen = through_water(Draw(CALIBRATION_SEED), pairs)
    return [image[None].numpy() for image in seen.a.image]


def _rounded(figures: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in figures.items()}
