"""`aquaflow lab prior train compact`: a pool of scenes, a training, and the folder that tracks."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from aquaflow.base.errors import ArgumentError, InputError
from aquaflow.lab.networks.compact.export import export
from aquaflow.lab.networks.compact.network import CompactPrior, NetworkSize
from aquaflow.lab.training.compact import CompactSettings, CompactTask, multiplies_bfloat16
from aquaflow.lab.training.compact_range import (
    calibration_figures,
    normalised_errors,
    variance_factor,
)
from aquaflow.lab.training.compact_recall import (
    mean_recall,
    onnx_comparison,
    onnx_encoder,
    tracked_recall,
)
from aquaflow.lab.training.compact_start import started
from aquaflow.lab.training.held_out import (
    RANGE_SET,
    REAL,
    SETS,
    check_held_out,
    held_out_pairs,
    is_dive,
    mapped_pairs,
    name_of,
    turned_pictures,
)
from aquaflow.lab.training.held_out import SEED as HELD_OUT_SEED
from aquaflow.lab.training.pair_generator.drawing import WindowVariation, through_water
from aquaflow.lab.training.pair_generator.map_pairs import MapPairs
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.real_pictures import RealPictures
from aquaflow.lab.training.pair_generator.scene import Detail
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD, Pool
from aquaflow.lab.training.pairs import Pair
from aquaflow.lab.training.trainer import (
    NOT_FIGURES,
    Progress,
    Schedule,
    TrainingPlan,
    has_ended,
    train,
)
from aquaflow.prior.folder import CARD, DECODER, ENCODER, PriorCard, sha256_of, write_card
from aquaflow.prior.runtime import INT8_ENCODER

POOL, PRIOR = "pool", "prior"
"""Folders of a run: training pairs, the exported prior."""
REGULAR_SHARE = 0.2
"""Of the pool's scenes: tiles and nets."""
VALIDATE_EVERY = 1000
"""Steps: a validation takes as long as 60 of them."""
ROWS = 12
"""Validations of a run that is too short for as many at VALIDATE_EVERY."""
RATE, RATE_FROM_START = 2e-3, 1e-4
"""Highest learning rate from random weights, and from weights that know already: at 5e-4 these lost
a third of their matches in 84 steps (notes/2026-11-priors.md#student)."""
CALIBRATION_SEED = 2000
"""Of the water over the pictures that 8-bit ranges are taken from."""
CALIBRATION_SHARDS = 2
"""Of the pool, 16 pairs: the pictures that the ranges are taken from."""


@dataclass(frozen=True)
class CompactRun:
    """All that a run's result follows from, together with the code."""

    seed: int = 1
    steps: int = 36_000
    hold: float = 0.7
    """Share of the steps at the highest rate; the rest anneals, on larger windows and with maps."""
    warm_up: int = 100
    rate: float = RATE
    lowest_rate: float = 2e-5
    settings: CompactSettings = field(default_factory=CompactSettings)
    looks: WindowVariation = field(default_factory=WindowVariation)
    late_looks: WindowVariation = field(
        default_factory=lambda: WindowVariation(width=160, height=112)
    )
    pictures: tuple[Path, ...] = ()
    """Folders of real pictures and clips; none: generated pairs only."""
    maps: tuple[Path, ...] = ()
    """Dive folders whose maps give pairs too, once the rate falls: up to there a run is the same
    with and without them, and a map may be made by the weights of that time."""
    held_out: tuple[Path, ...] = ()
    """Folders of others: of finished dives, for figures of pairs of their maps at every validation,
    or of pictures, for figures of these turned once the training is over."""
    size: float = 1.0
    """Weights of the network, as a multiple of those that ship."""
    start: Path | None = None
    """Exported prior that the weights are taken from; None: they are random."""
    workers: int = 0
    """Processes that render scenes ahead; none changes what is learnt."""

    @property
    def schedule(self) -> Schedule:
        """Warm-up, hold, half a cosine."""
        hold = round(self.hold * self.steps)
        return Schedule(self.steps, self.warm_up, self.rate, self.lowest_rate, hold)

    def looks_at(self, step: int) -> WindowVariation:
        """Small windows first: most is learnt there, in half the time."""
        return self.looks if step < self.schedule.hold else self.late_looks


def train_compact(
    run: CompactRun, out: Path, progress: Progress, device: str = "cpu", hours: float | None = None
) -> PriorCard | None:
    """Train on ``device`` in ``out``, continuing an earlier run there; export to ``out``/prior.

    None if ``hours`` were over before the training was: the same call goes on.

    Raises:
        InputError: ``out`` holds the checkpoint of another network, there is no such device, a
            folder of pictures holds none, a dive no map that can be learnt from, or a dive is
            held out and learned from.
    """
    place = device_called(device)
    dives = [folder for folder in run.held_out if is_dive(folder)]
    check_held_out(dives, run.maps)
    torch.manual_seed(run.seed)
    pool = Pool(out / POOL, run.seed, detail=Detail(regular=REGULAR_SHARE))
    real = RealPictures(run.pictures, pool.width, pool.height) if run.pictures else None
    maps = map_pairs(run, pool, progress) if run.maps else None
    first = -(-min(run.settings.first_scenes, run.settings.scenes) // SHARD)
    for shard in range(first):
        pool.ensure(shard)
        progress("scenes", shard + 1, first)
    held_out = {"": held_out_pairs(out, SETS["wide"])}
    of_dives = {
        name_of(dive): mapped_pairs(out, dive, pool.width, pool.height, progress) for dive in dives
    }
    held_out |= {f"{name}_": pairs for name, pairs in of_dives.items()}
    network = first_network(run, pool).to(place)
    task = CompactTask(
        network,
        pool,
        held_out,
        run.settings,
        run.looks_at,
        run.seed,
        real,
        maps,
        run.schedule.hold,
    )
    plan = TrainingPlan(
        run.schedule,
        validate_every=min(VALIDATE_EVERY, max(run.steps // ROWS, 1)),
        validate_first=run.start is not None,
        hours=hours,
    )
    with rendering_ahead(pool, -(-run.settings.scenes // SHARD), run.workers):
        history = train(task, plan, out, progress)
    if not has_ended(history, run.schedule):
        return None
    record = training_record(run, history, hardware_of(device))
    card = export(network.cpu(), out / PRIOR, record, calibration(pool), progress)
    card = with_honest_range(out / PRIOR, card, held_out_pairs(out, RANGE_SET))
    sets = {name: held_out_pairs(out, chosen) for name, chosen in SETS.items()}
    sets |= of_dives
    pictures = [folder for folder in run.held_out if folder not in dives]
    if pictures:
        sets[REAL] = turned_pictures(pictures)
    return with_figures(out / PRIOR, card, sets)


def first_network(run: CompactRun, pool: Pool) -> CompactPrior:
    """Of the run's size, with the weights that its training starts from.

    Raises:
        InputError: the prior to start from is none, or larger.
    """
    size = NetworkSize().times(run.size)
    if run.start is None:
        return CompactPrior(size)
    return started(run.start, size, through_water(Draw(CALIBRATION_SEED), first_pairs(pool)))


@contextmanager
def rendering_ahead(pool: Pool, shards: int, workers: int) -> Iterator[None]:
    """Meanwhile other processes render what the pool lacks, in the order of its use."""
    if workers == 0:
        yield
        return
    ahead = replace(pool)  # without the pairs in memory: every task carries it
    with get_context("spawn").Pool(workers, torch.set_num_threads, (1,)) as processes:
        processes.map_async(ahead.ensure, range(shards), chunksize=1)
        yield


def map_pairs(run: CompactRun, pool: Pool, progress: Progress) -> MapPairs:
    """Pairs of the run's maps, rendered into the pool's folder."""
    count = run.settings.map_pairs
    pairs = MapPairs(run.maps, pool.folder, run.seed, pool.width, pool.height, count)
    pairs.render(progress)
    return pairs


def device_called(name: str) -> torch.device:
    """cpu, cuda or cuda:N.

    Raises:
        ArgumentError: torch knows no such device.
        InputError: it is not here.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ArgumentError(f"there is no device '{name}'; give cpu or cuda") from error
    if device.type not in ("cpu", "cuda"):
        raise ArgumentError(f"training on '{name}' is not supported; give cpu or cuda")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(f"torch finds no GPU for device '{name}'; give cpu")
    return device


def training_record(
    run: CompactRun, history: list[dict[str, float]], hardware: str
) -> dict[str, Any]:
    """What prior.json keeps of a training."""
    return {
        "data": "generated pictures (aquaflow.lab.training.pair_generator)",
        "pictures": [folder.name for folder in run.pictures],
        "maps": [folder.name for folder in run.maps],
        "seed": run.seed,
        "pool_seed": run.seed,
        "held_out_seed": HELD_OUT_SEED,
        "size": run.size,
        "start": None if run.start is None else sha256_of(run.start / CARD),
        "steps": run.steps,
        "pairs": run.steps * run.settings.batch,
        "scenes": run.settings.scenes,
        "hardware": hardware,
        "torch": torch.__version__,
        "cpu_s": history[-1]["cpu_s"],
        "held_out": {
            name: round(value, 4)
            for name, value in history[-1].items()
            if name not in NOT_FIGURES and not name.startswith("loss_")
        },
    }


def hardware_of(device: str) -> str:
    """What trains, in words."""
    place = torch.device(device)
    arithmetic = "bfloat16" if multiplies_bfloat16(place) else "32 bits"
    if place.type == "cuda":
        return f"{torch.cuda.get_device_name(place)}, {arithmetic}"
    cores, threads = os.cpu_count(), torch.get_num_threads()
    return f"{platform.machine()} CPU, {threads} of {cores} cores, {arithmetic}"


def calibration(pool: Pool) -> list[Any]:
    """[1, 3, H, W] pictures of the pool, through water, for the 8-bit encoder."""
    seen = through_water(Draw(CALIBRATION_SEED), first_pairs(pool))
    return [image[None].numpy() for image in seen.a.image]


def first_pairs(pool: Pool) -> Pair:
    """Those that statistics are taken from."""
    return pool.pairs(torch.arange(CALIBRATION_SHARDS * SHARD))


# --------------------------------------------------------------------------------------------------
# What an exported compact prior finds of held-out pairs, as its card says, in 32 and in 8 bits.

ENCODERS = {"32_bit": ENCODER, "8_bit": INT8_ENCODER}
"""Files by the name that figures have in the card."""
LEAST_FACTOR = 1.0
"""Of the range's variance: on pairs of the training's kind errors are smaller than said (0.86), on
harder ones larger, and a variance that is too small harms more than one that is too large."""


def with_honest_range(folder: Path, card: PriorCard, pairs: list[Pair]) -> PriorCard:
    """The card of ``folder`` with the factor that makes the range's variance no less than that of
    ``pairs``.

    Fitted in 8 bits, which is what runs on a CPU; ``with_figures`` shows how well it holds in 32.
    """
    encode, compare = onnx_encoder(folder / INT8_ENCODER), onnx_comparison(folder / DECODER)
    factor = max(LEAST_FACTOR, variance_factor(normalised_errors(encode, compare, pairs)))
    card = card.model_copy(update={"range_variance_factor": round(factor, 4)})
    write_card(folder, card)
    return card


def with_figures(folder: Path, card: PriorCard, sets: dict[str, list[Pair]]) -> PriorCard:
    """The card of ``folder``, extended by its figures on several sets of pairs."""
    figures = {name: figures_of(folder, card, pairs) for name, pairs in sets.items()}
    card = card.model_copy(update={"training": (card.training or {}) | {"figures": figures}})
    write_card(folder, card)
    return card


def figures_of(folder: Path, card: PriorCard, pairs: list[Pair]) -> dict[str, Any]:
    """Recall in 32 and 8 bits, and how honest the variance is."""
    compare = onnx_comparison(folder / DECODER)
    figures: dict[str, Any] = {
        "pairs": sum(len(pair.a.K) for pair in pairs),
        "flow_alone_2px": round(tracked_recall(None, pairs)["flow_2px"], 4),
    }
    for bits, file in ENCODERS.items():
        encode = onnx_encoder(folder / file)
        found = mean_recall(encode, compare, pairs) | tracked_recall(encode, pairs)
        errors = normalised_errors(encode, compare, pairs)
        found |= calibration_figures(errors / card.range_variance_factor**0.5)
        figures[bits] = {name: round(value, 4) for name, value in found.items()}
    return figures
