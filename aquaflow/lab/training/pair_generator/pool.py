"""The pool of generated scenes, each rendered once and used many times."""

from __future__ import annotations

from dataclasses import dataclass, field

from aquaflow.lab.training.pair_generator.cameras import TRAINING, PairMotion
from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.render import render_pairs
from aquaflow.lab.training.pair_generator.scene import Detail
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD, STRIDE, StoredPairs
from aquaflow.lab.training.pairs import Pair


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
