"""Pairs that the compact prior is never trained on: generated, of dives, and turned pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import MAP
from aquaflow.lab.training.pair_generator.cameras import TRAINING, WIDE, WIDER, PairMotion
from aquaflow.lab.training.pair_generator.conditions import CALM, Conditions
from aquaflow.lab.training.pair_generator.drawing import WindowVariation, through_water, windows
from aquaflow.lab.training.pair_generator.map_pairs import MapPairs
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.real_pictures import RealPictures
from aquaflow.lab.training.pair_generator.scene import Detail
from aquaflow.lab.training.pair_generator.sensor import take_picture
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD, Pool
from aquaflow.lab.training.pairs import Pair, overlap
from aquaflow.lab.training.trainer import Progress
from aquaflow.prior.folder import sha256_of

SEED = 1000
"""Of the scenes that are never trained on, and of their water."""
LEAST_OVERLAP = 0.3
"""As in the paper's pair mining."""
COUNT = 64
"""Pairs of a set."""
MAPPED = 32
"""Pairs of a held-out dive."""
HELD_OUT_MAPS = "held_out_maps"
"""Folder of a run that keeps them."""
REAL = "real"
"""Name of the figures of real pictures."""
TOGETHER = 8
"""Pairs of a batch."""
REAL_SIZE = (480, 360)
"""px of the real pictures that windows are cut from."""
REAL_WINDOWS = WindowVariation(width=320, height=240)
"""Of pairs of real pictures: the size that is tracked, turned and zoomed as in training."""


@dataclass(frozen=True)
class HeldOutSet:
    """Generated pairs of one kind."""

    folder: str
    """Of the run, that keeps them."""
    motion: PairMotion
    detail: Detail = field(default_factory=Detail)
    conditions: Conditions = CALM
    seed: int = SEED


SETS = {
    "wide": HeldOutSet("held_out", WIDE),
    "wider": HeldOutSet("held_out_wider", WIDER),
    "hard": HeldOutSet(
        "held_out_hard", TRAINING, Detail(regular=0.3), Conditions().scale(2.0), SEED + 1
    ),
}
"""Those that figures are given for; ``hard`` has all that a training has, twice as often."""
RANGE_SET = HeldOutSet("held_out_range", TRAINING, conditions=Conditions(), seed=SEED + 2)
"""That the factor of the range's variance is fitted on."""


def held_out_pairs(run: Path, chosen: HeldOutSet, count: int = COUNT) -> list[Pair]:
    """Batches of pairs that overlap enough, rendered where the folder of ``run`` lacks them."""
    pool = Pool(run / chosen.folder, chosen.seed, motion=chosen.motion, detail=chosen.detail)
    numbers: list[int] = []
    number = 0
    while len(numbers) < count:
        pair = pool.pairs(torch.arange(number, number + SHARD))
        numbers += [number + int(i) for i in torch.nonzero(overlap(pair) >= LEAST_OVERLAP)]
        number += SHARD
    draw = Draw(chosen.seed)
    parts = [numbers[i : min(i + TOGETHER, count)] for i in range(0, count, TOGETHER)]
    return [
        through_water(draw, pool.pairs(torch.tensor(part)), chosen.conditions) for part in parts
    ]


def is_dive(folder: Path) -> bool:
    """True for a finished dive, false for what is meant as a folder of pictures."""
    return (folder / MAP).is_file()


def check_held_out(dives: Sequence[Path], learned: Sequence[Path]) -> None:
    """Check that no held-out dive is learned from, by another path or as a copy either, and that
    figures of each have a name of their own.

    Raises:
        InputError: one is, or two sets of pairs are called the same.
    """
    hashes = {sha256_of(dive / MAP): dive for dive in learned if is_dive(dive)}
    names = {*SETS, REAL}
    for dive in dives:
        if (same := hashes.get(sha256_of(dive / MAP))) is not None:
            raise InputError(
                f"{dive} is held out and {same}, to be learned from, has the same map; "
                "leave one of them out"
            )
        if name_of(dive) in names:
            raise InputError(
                f"figures of {dive} would be called '{name_of(dive)}' like others; "
                "give a copy or link of another name"
            )
        names.add(name_of(dive))


def name_of(dive: Path) -> str:
    """What the figures of a held-out dive are called."""
    return dive.resolve().name


def mapped_pairs(
    run: Path, dive: Path, width: int, height: int, progress: Progress, count: int = MAPPED
) -> list[Pair]:
    """Batches of pairs of a dive's map, rendered where the folder of ``run`` lacks them.

    Raises:
        InputError: the map is damaged, or shows too little.
    """
    maps = MapPairs([dive], run / HELD_OUT_MAPS, SEED, width, height, count)
    maps.render(progress)
    draw = Draw(SEED)
    parts = torch.split(torch.arange(count), TOGETHER)
    return [through_water(draw, maps.maps[0].pairs(part)) for part in parts]


def turned_pictures(folders: Sequence[Path], count: int = COUNT) -> list[Pair]:
    """Batches of pairs of real pictures related by homographies, each as taken by another camera.

    Raises:
        InputError: a folder does not exist or holds no picture that can be read.
    """
    pictures = RealPictures(folders, *REAL_SIZE)
    draw = Draw(SEED)
    pairs = []
    for _ in range(0, count, TOGETHER):
        pair = windows(draw, pictures.pairs(draw, TOGETHER), REAL_WINDOWS)
        a, b = (replace(view, image=take_picture(draw, view.image)) for view in (pair.a, pair.b))
        pairs.append(Pair(a, b))
    return pairs
