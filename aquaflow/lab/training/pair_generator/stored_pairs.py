"""Pairs on disk, before water: geometry costs 50 times what water and sensor cost, and is kept.

A file's content follows from its number alone, so that a second process may make files ahead of the
one that trains, and a folder that was cut short is continued.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from aquaflow.base.storage.atomic import atomic_write
from aquaflow.lab.training.pair_generator.cameras import TRAINING, PairMotion
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.render import BRIGHTEST, render_pairs
from aquaflow.lab.training.pair_generator.scene import Detail
from aquaflow.lab.training.pairs import Pair, ViewBatch

SHARD = 8
"""Pairs of a file."""
STRIDE = 1_000_003
"""Between the seeds of pools: shards of different pools never share a seed."""


@dataclass
class StoredPairs(ABC):
    """Pairs by number, rendered when first asked for."""

    folder: Path
    _loaded: dict[int, dict[str, Tensor]] = field(default_factory=dict, init=False, repr=False)

    @property
    @abstractmethod
    def name(self) -> str:
        """Start of the files' names: that of all that their content follows from."""

    @abstractmethod
    def render(self, shard: int) -> Pair:
        """The SHARD pairs of a file: radiances without water."""

    def pairs(
        self,
        numbers: Tensor,  # [B] int64
    ) -> Pair:
        """Pairs of radiances without water."""
        rows = [self._shard(n // SHARD) for n in numbers.tolist()]
        places = (numbers % SHARD).tolist()
        stacked = {
            name: torch.stack([row[name][place] for row, place in zip(rows, places, strict=True)])
            for name in rows[0]
        }
        return Pair(_view(stacked, "a"), _view(stacked, "b"))

    def ensure(self, shard: int) -> bool:
        """Render the shard if it is not on disk; true if it was rendered."""
        path = self._path(shard)
        if path.is_file():
            return False
        self.folder.mkdir(parents=True, exist_ok=True)
        with torch.no_grad():
            pair = self.render(shard)
        with atomic_write(path) as stream:
            torch.save(_pack(pair.a, "a") | _pack(pair.b, "b"), stream)
        return True

    def _shard(self, shard: int) -> dict[str, Tensor]:
        if shard not in self._loaded:
            self.ensure(shard)
            self._loaded[shard] = torch.load(self._path(shard), weights_only=True)
        return self._loaded[shard]

    def _path(self, shard: int) -> Path:
        return self.folder / f"{self.name}_{shard:05d}.pt"


def _pack(view: ViewBatch, name: str) -> dict[str, Tensor]:
    """Radiance in 8 bits, depth in 16: a twentieth of a pixel at the widest parallax.

    A depth that water is drawn with but nothing is learnt from is stored as a negative one.
    """
    return {
        f"image_{name}": (view.image * (255.0 / BRIGHTEST)).round().byte(),
        f"depth_{name}": torch.where(view.valid, view.depth, -view.depth).half(),
        f"K_{name}": view.K,
        f"T_wc_{name}": view.T_wc,
    }


def _view(
    stacked: dict[str, Tensor],  # as from _packed
    name: str,
) -> ViewBatch:
    depth = stacked[f"depth_{name}"].float()
    image = stacked[f"image_{name}"].float() * (BRIGHTEST / 255.0)
    return ViewBatch(image, depth.abs(), stacked[f"K_{name}"], stacked[f"T_wc_{name}"], depth > 0)


# --------------------------------------------------------------------------------------------------
# The pool of generated scenes, each rendered once and used many times.


@dataclass
class Pool(StoredPairs):
    """Generated pairs; a shard's content follows from the pool's seed and its number."""

    seed: int
    width: int = 192
    height: int = 144
    motion: PairMotion = TRAINING
    detail: Detail = field(default_factory=Detail)

    @property
    def name(self) -> str:
        return f"pairs_{self.width}x{self.height}_{self.seed}"

    def render(self, shard: int) -> Pair:
        draw = Draw(self.seed * STRIDE + shard)
        return render_pairs(draw, SHARD, self.width, self.height, self.motion, self.detail)
