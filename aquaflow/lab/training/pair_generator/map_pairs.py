"""Pairs from the maps of finished dives: what really lies on the floor, at known ranges.

The first view is near a mapped one. The second is near another one, or moved as in generated pairs.
Both are kept only if the map covers them, so that what is learnt from was seen. Where the dive has
kept pictures of what it mapped, half of the pairs are two of these, with the ranges of the map.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from aquaflow.base.errors import InputError, reason_of
from aquaflow.dive.map_file import SUFFIX, read_map_file
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.training.pair_generator.cameras import (
    TRAINING,
    PairMotion,
    intrinsics,
    moved_camera,
)
from aquaflow.lab.training.pair_generator.noise import Draw
from aquaflow.lab.training.pair_generator.render import BRIGHTEST, median_depth
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD, STRIDE, StoredPairs
from aquaflow.lab.training.pairs import (
    Pair,
    ViewBatch,
    correspondences,
    join,
    joined_views,
    overlap,
)
from aquaflow.mapping.scene import show
from aquaflow.mapping.state import NO_PIXELS
from aquaflow.recordings.kept_pictures import KeptPictures
from aquaflow.render import select_renderer
from aquaflow.render.views import View, in_time

NEAR = PairMotion(baseline=0.1, power=1.0, tilt=0.05, roll=0.15)
"""Of a view from a mapped one."""
FIELD_OF_VIEW = (0.75, 1.15)
"""Of the widest that fits into a mapped picture: a wider one is covered by its neighbours."""
NEAR_ANOTHER = 0.5
"""Share of the second views that are near a mapped one: far from all, maps of one pass have holes,
and of what is drawn there only the short baselines would be left."""
PHOTOGRAPHED = 0.5
"""Share of the pairs that are two pictures which the dive has kept."""
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
        pictures = [path for _, path in sorted(kept_pictures(self.map_file).items())]
        content = hashlib.sha256()
        for path in (self.map_file, *pictures):
            content.update(path.read_bytes())
        return f"map_{content.hexdigest()[:12]}_{self.width}x{self.height}_{self.seed}"

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
    if len(scene.photographed) > 1 and bool(draw.chance(PHOTOGRAPHED)):
        return photographed_pair(draw, scene, width, height)
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


def photographed_pair(draw: Draw, scene: MappedScene, width: int, height: int) -> Pair | None:
    """Two pictures as the camera took them, or None if the map does not cover them."""
    chosen = torch.randperm(len(scene.photographed), generator=draw.generator)[:2].tolist()
    a, b = (scene.photograph(scene.photographed[i], width, height) for i in chosen)
    pair = Pair(a, b)
    if not (_is_covered(a) and _is_covered(b)) or float(overlap(pair)) < LEAST_OVERLAP:
        return None
    return pair


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


def kept_pictures(map_file: Path) -> dict[int, Path]:
    """Pictures that the dive of this map has kept, by the frame's index."""
    return KeptPictures(map_file.parent, math.inf).paths


# --------------------------------------------------------------------------------------------------
# A dive's map as a scene to take pictures of: its Gaussians without water, from any place.

SHOWN, COVERED = 0.5, 0.9
"""Alpha from which a pixel shows the map and not open water, and from which it has a range."""
FINEST = 4
"""Pixels along a side of one, at most, that are drawn and averaged: a Gaussian is never smaller
than a pixel, and would look larger in a picture that is coarser than those it was made from."""
NEIGHBOURS = 12
"""Mapped views, the nearest ones, that are asked whether they saw what is drawn."""
WITNESSES = 2
"""Of them that must have, at the same range: what one saw alone may be anywhere on its ray."""
REAL_WIDTH = 160
"""px of the ranges that the mapped views are asked for."""


class MappedScene:
    """The map of a finished dive."""

    def __init__(self, map_file: Path) -> None:
        """Read ``map_file``.

        Raises:
            InputError: it is no map, or none of more than WITNESSES views.
        """
        # The CPU's renderer everywhere, so that a seed gives the same pairs everywhere.
        self._mapper = read_map_file(map_file, select_renderer("cpu"))
        self._mapped = in_time(self._mapper.views)
        if len(self._mapped) <= WITNESSES or len(self._mapper.gaussians) == 0:
            raise InputError(f"the map {map_file} has too few views to learn from; leave it out")
        self.T_wc = torch.stack([_matrix(view.T_wc) for view in self._mapped])
        """[V, 4, 4] the mapped views' cameras to world."""
        self.camera: CameraModel = self._mapped[0].camera
        self._seen: dict[int, ViewBatch] = {}
        kept = kept_pictures(map_file)
        self._pictures = {
            number: kept[view.frame_index]
            for number, view in enumerate(self._mapped)
            if view.frame_index in kept
        }
        self.photographed = list(self._pictures)
        """Mapped views whose picture the dive has kept."""

    def view(
        self,
        K: Tensor,  # [1, 3, 3] px
        T_wc: Tensor,  # [1, 4, 4]
        width: int,
        height: int,
    ) -> ViewBatch:
        """The map's radiance, valid where it is solid and mapped views saw it at that range."""
        drawn = self._draw(K, T_wc, width, height)
        away = (self.T_wc[:, :3, 3] - T_wc[0, :3, 3]).norm(dim=1)
        nearest = away.argsort(stable=True)[:NEIGHBOURS].tolist()
        witnesses = joined_views([self.render_mapped(number) for number in nearest])
        repeated = joined_views([drawn] * len(nearest))
        seen = correspondences(Pair(repeated, witnesses)).visible.sum(0) >= WITNESSES
        return ViewBatch(drawn.image, drawn.depth, K, T_wc, drawn.valid & seen[None])

    def photograph(self, number: int, width: int, height: int) -> ViewBatch:
        """The picture of a photographed view, its middle as large as fits, at the map's ranges;
        valid as in ``view``.

        Raises:
            InputError: it cannot be read.
        """
        picture = cv2.imread(str(self._pictures[number]), cv2.IMREAD_COLOR_RGB)
        if picture is None:
            raise InputError(f"cannot read {self._pictures[number]}; delete it")
        rows, columns = picture.shape[:2]
        scale = max(width / columns, height / rows)
        size = (max(round(scale * columns), width), max(round(scale * rows), height))
        left, top = (size[0] - width) // 2, (size[1] - height) // 2
        resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        window = resized[top : top + height, left : left + width]
        K = torch.from_numpy(self._mapped[number].camera.resize(*size).K).float()[None]
        K[:, 0, 2] -= left
        K[:, 1, 2] -= top
        image = torch.from_numpy(np.ascontiguousarray(window.transpose(2, 0, 1)))[None]
        drawn = self.view(K, self.T_wc[number][None], width, height)
        return replace(drawn, image=image.float() / 255.0)

    def render_mapped(self, number: int) -> ViewBatch:
        """The map as drawn from a mapped view, valid where it is solid."""
        if number not in self._seen:
            real = self._mapped[number].camera
            width, height = REAL_WIDTH, round(REAL_WIDTH * real.height / real.width)
            K = torch.from_numpy(real.resize(width, height).K).float()[None]
            self._seen[number] = self._draw(K, self.T_wc[number][None], width, height)
        return self._seen[number]

    def depth(
        self,
        number: Tensor,  # [1] int64
    ) -> Tensor:
        """[1] median of what a mapped view sees."""
        return median_depth(self.render_mapped(int(number)))

    @torch.no_grad()
    def _draw(
        self,
        K: Tensor,  # [1, 3, 3] px
        T_wc: Tensor,  # [1, 4, 4]
        width: int,
        height: int,
    ) -> ViewBatch:
        finer = min(max(round(self.camera.fx / float(K[0, 0, 0])), 1), FINEST)
        fx, fy, cx, cy = (finer * K[0, [0, 1, 0, 1], [0, 1, 2, 2]]).tolist()
        camera = CameraModel(finer * width, finer * height, fx, fy, cx, cy)
        pose = T_wc[0].double().numpy()
        view = View(0, NO_PIXELS, camera, Sim3(pose[:3, :3], pose[:3, 3]), keyframe=0, robust=False)
        scene, viewmat = self._mapper.scene, view.viewmat()
        shown = show(scene.seen_from(view, viewmat), None, None, scene.renderer, view, viewmat)
        rays = camera.unproject(camera.pixel_centres())
        z = shown.z / torch.from_numpy(np.linalg.norm(rays, axis=-1)).float()
        layers = [scene.apply_white_balance(shown.radiance), shown.alpha[..., None]]
        layers.append((shown.alpha * z)[..., None])
        layers_chw = torch.cat(layers, -1).permute(2, 0, 1)[None]
        averaged = F.avg_pool2d(layers_chw, finer)
        image, alpha, depth = averaged[:, :3], averaged[:, 3:4], averaged[:, 4:]
        solid = alpha > SHOWN
        image = torch.where(solid, image / alpha.clamp_min(SHOWN), 0.0).clamp(0.0, BRIGHTEST)
        depth = torch.where(solid, depth / alpha.clamp_min(SHOWN), 0.0)[:, 0]
        return ViewBatch(image, depth, K, T_wc, (alpha[:, 0] > COVERED) & (depth > 0.0))


def _matrix(T: Sim3) -> Tensor:
    """[4, 4]"""
    matrix = torch.eye(4)
    matrix[:3, :3], matrix[:3, 3] = torch.from_numpy(T.R), torch.from_numpy(T.t)
    return matrix
