"""Pairs whose matches are known exactly: held-out generated scenes, and pictures warped by us."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.evaluation.matching import HEIGHT, LEVELS, WIDTH, homography_pair
from aquaflow.lab.prior_bench.pair import KnownPair, Picture
from aquaflow.lab.training.correspondences import correspondences, overlap
from aquaflow.lab.training.held_out import LEAST_OVERLAP, SEED
from aquaflow.lab.training.pair_generator.cameras import WIDE, WIDER, PairMotion
from aquaflow.lab.training.pair_generator.draw import Draw
from aquaflow.lab.training.pair_generator.drawing import through_water
from aquaflow.lab.training.pair_generator.pool import Pool
from aquaflow.lab.training.pair_generator.stored_pairs import SHARD
from aquaflow.lab.training.pairs import Pair, ViewBatch

GENERATED: dict[str, PairMotion] = {"generated, wide": WIDE, "generated, wider": WIDER}
"""The held-out motions, by the name of their group."""
SIDES = (320, 240)
"""Width and height of generated pictures. Training looks at windows of 128 x 96: networks of others
were trained on larger pictures."""
FOCAL_WIDTHS = 0.75
"""Focal length of a warped picture's camera over its width; no figure depends on it."""


def generated_pairs(folder: Path, count: int) -> list[KnownPair]:
    """``count`` pairs of either motion, of scenes that nothing is trained on; rendered where
    ``folder`` lacks them."""
    found: list[KnownPair] = []
    for group, motion in GENERATED.items():
        pool = Pool(folder / group.rpartition(" ")[2], SEED, *SIDES, motion=motion)
        draw, number, before = Draw(SEED), 0, len(found)
        while len(found) - before < count:
            clear = pool.pairs(torch.arange(number, number + SHARD))
            wet, enough = through_water(draw, clear), overlap(clear) >= LEAST_OVERLAP
            rows = torch.nonzero(enough)[:, 0].tolist()[: count - (len(found) - before)]
            found += _known_pairs_of(wet, group, rows)
            number += SHARD
    return found


def warped_pairs(
    pictures: Sequence[Picture],  # [H, W, 3] RGB each
    count: int,
) -> list[KnownPair]:
    """``count`` pairs of each level of distortion: pictures against themselves, turned, moved and
    relit."""
    camera = CameraModel(
        WIDTH, HEIGHT, FOCAL_WIDTHS * WIDTH, FOCAL_WIDTHS * WIDTH, WIDTH / 2, HEIGHT / 2
    )
    rng = np.random.default_rng(0)
    found = []
    for level in LEVELS:
        for number in range(count):
            pair = homography_pair(pictures[number % len(pictures)], level, rng)
            found.append(
                KnownPair(
                    f"warped, {level.name}", pair.a, pair.b, camera, camera, pair.truth, pair.inside
                )
            )
    return found


def _known_pairs_of(pair: Pair, group: str, rows: list[int]) -> list[KnownPair]:
    matches = correspondences(pair)
    T_ba = torch.linalg.solve(pair.b.T_wc, pair.a.T_wc).numpy().astype(np.float64)
    return [
        KnownPair(
            group,
            _picture(pair.a.image[row]),
            _picture(pair.b.image[row]),
            _camera(pair.a, row),
            _camera(pair.b, row),
            matches.pixels[row].numpy(),
            matches.visible[row].numpy(),
            Sim3(T_ba[row, :3, :3], T_ba[row, :3, 3]),
        )
        for row in rows
    ]


def _picture(
    image: Tensor,  # [3, H, W] in [0, 1]
) -> Picture:
    return np.ascontiguousarray((255.0 * image).round().byte().permute(1, 2, 0).numpy())


def _camera(view: ViewBatch, row: int) -> CameraModel:
    height, width = view.depth.shape[-2:]
    (fx, _, cx), (_, fy, cy), _ = view.K[row].double().tolist()
    return CameraModel(width, height, fx, fy, cx, cy)
