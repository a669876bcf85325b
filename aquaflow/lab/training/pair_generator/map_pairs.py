"""Pairs from the maps of finished dives: what really lies on the floor, at known ranges.

The first view is near a mapped one. The second is near another one, or moved as in generated pairs.
Both are kept only if the map covers them, so that what is learnt from was seen.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from aquaflow.base.errors import InputError, reason_of
from aquaflow.dive.map_file import SUFFIX
from aquaflow.geometry.camera import CameraModel
from aquaflow.lab.training.correspondences import overlap
from aquaflow.lab.training.pair_generator.cameras import (
    TRAINING,
    PairMotion,
    intrinsics,
    moved_camera,
)
from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.mapped_scene import MappedScene
from aquaflow.lab.training.pair_generator.render import BRIGHTEST, median_depth
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD, STRIDE, StoredPairs
from aquaflow.lab.training.pairs import Pair, ViewBatch, join

NEAR = PairMotion(baseline=0.1, power=1.0, tilt=0.05, roll=0.15)
"""Of a view from a mapped one."""
FIELD_OF_VIEW = (0.75, 1.15)
"""Of the widest that fits into a mapped picture: a wider one is covered by its neighbours."""
NEAR_ANOTHER = 0.5
"""Share of the second views that are near a mapped one: far from all, maps of one pass have holes,
and of what is drawn there only the short baselines would be left."""
LEAST_COVERED = 0.7
"""Of either view's pixels, that the map shows at a range that mapped views saw."""
LEAST_OVERLAP = 0.3
"""As in the paper's pair mining."""
ATTEMPTS = 400
"""For the pairs of a file; the maps of two clips took 12 and 16."""
BRIGHT_QUANTILE, BRIGHT_LEVEL = 0.995, 1.0
"""This share of the first view's radiances is below this level."""

Progress = Callable[[str, int, int], None]


class MapPairs:
    """Pairs from the maps of several dives, the same number from each."""

    def __init__(
        self, dives: Sequence[Path], folder: Path, seed: int, width: int, height: int, count: int
    ) -> None:
        """``count`` pairs of each dive, in ``folder``.

        Raises:
            InputError: a folder has no map.
        """
        self.count = count
        self.maps = [MapPool(folder, _map_file(dive), seed, width, height) for dive in dives]

    def render(self, progress: Progress) -> None:
        """What is not on disk yet.

        Raises:
            InputError: a map is damaged, or shows too little to learn from.
        """
        shards = -(-self.count // SHARD)
        for place, pool in enumerate(self.maps):
            for shard in range(shards):
                pool.ensure(shard)
                progress("pairs of maps", place * shards + shard + 1, shards * len(self.maps))

    def pairs(self, draw: Draw, batch: int) -> Pair:
        """``batch`` of the pairs, radiances without water."""
        which = draw.whole(batch, below=len(self.maps)).tolist()
        numbers = draw.whole(batch, below=self.count).cpu()
        parts = [self.maps[m].pairs(numbers[i : i + 1]) for i, m in enumerate(which)]
        return join(parts).to(draw.device)


@dataclass
class MapPool(StoredPairs):
    """Pairs of one map; a file's content follows from the map's, the seed and its number."""

    map_file: Path
    seed: int
    width: int
    height: int

    @cached_property
    def name(self) -> str:
        content = hashlib.sha256(self.map_file.read_bytes()).hexdigest()
        return f"map_{content[:12]}_{self.width}x{self.height}_{self.seed}"

    @cached_property
    def scene(self) -> MappedScene:
        """The map, read when it is first needed: not where all pairs are on disk."""
        return MappedScene(self.map_file)

    def render(self, shard: int) -> Pair:
        draw = Draw(self.seed * STRIDE + shard)
        found: list[Pair] = []
        for _ in range(ATTEMPTS):
            pair = drawn_pair(draw, self.scene, self.width, self.height)
            if pair is not None:
                found.append(pair)
            if len(found) == SHARD:
                return join(found)
        raise InputError(
            f"the map {self.map_file} shows too few places well from two views; leave it out"
        )


def drawn_pair(draw: Draw, scene: MappedScene, width: int, height: int) -> Pair | None:
    """One pair, or None if the map does not cover what was drawn."""
    number = draw.whole(1, below=len(scene.T_wc))
    widest = widest_view_deg(scene.camera, width, height)
    fov = (FIELD_OF_VIEW[0] * widest, FIELD_OF_VIEW[1] * widest)
    K = intrinsics(draw, 1, width, height, fov)
    T_a = moved_camera(draw, scene.T_wc[number], scene.depth(number), NEAR)
    a = scene.view(K, T_a, width, height)
    if not _is_covered(a):
        return None
    b = scene.view(K, _second_camera(draw, scene, a), width, height)
    pair = Pair(a, b)
    if not _is_covered(b) or float(overlap(pair)) < LEAST_OVERLAP:
        return None
    return _expose(pair)


def _second_camera(draw: Draw, scene: MappedScene, a: ViewBatch) -> Tensor:
    """[1, 4, 4] camera to world."""
    depth = median_depth(a)
    away = (scene.T_wc[:, :3, 3] - a.T_wc[:, :3, 3]).norm(dim=1)
    within = (away < TRAINING.baseline * depth).nonzero()[:, 0]
    if len(within) == 0 or not bool(draw.chance(NEAR_ANOTHER)):
        return moved_camera(draw, a.T_wc, depth, TRAINING)
    number = within[draw.whole(1, below=len(within))]
    return moved_camera(draw, scene.T_wc[number], scene.depth(number), NEAR)


def widest_view_deg(camera: CameraModel, width: int, height: int) -> float:
    """Horizontal field of view of the largest picture of this shape within the camera's."""
    half = min(0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy * width / height)
    return 2.0 * math.degrees(math.atan(half))


def _is_covered(view: ViewBatch) -> bool:
    return float(view.valid.float().mean()) >= LEAST_COVERED


def _expose(pair: Pair) -> Pair:
    """Radiances of the level that generated ones have, the same factor for both views."""
    bright = torch.quantile(pair.a.image, BRIGHT_QUANTILE).clamp_min(1e-3)
    a, b = (
        replace(view, image=(view.image * (BRIGHT_LEVEL / bright)).clamp_max(BRIGHTEST))
        for view in (pair.a, pair.b)
    )
    return Pair(a, b)


def _map_file(dive: Path) -> Path:
    """The dive's largest map."""
    path = dive / f"map{SUFFIX}"
    try:
        with path.open("rb"):
            return path
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {reason_of(error)}; give the folder of a finished dive"
        ) from error
