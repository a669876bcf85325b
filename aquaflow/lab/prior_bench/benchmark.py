"""Selects the priors to time, and assembles the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.config import PriorConfig
from aquaflow.config.stage import COMMAND_LINE, validate
from aquaflow.lab.bench import machine
from aquaflow.lab.evaluation.matching import LEVELS, Picture, homography_recall, matcher_of
from aquaflow.lab.prior_bench.latency import BenchmarkedPrior, latency_rows, sea_floor
from aquaflow.prior.factory import SHIPPED, make_prior
from aquaflow.prior.folder import CARD, read_card
from aquaflow.prior.runtime import INT8_ENCODER

SIZES = ((320, 240), (640, 480))
"""Width and height: the one that the cost is bounded at, and one of four times the pixels."""

PAIRS = 12
"""Of each level that recall is measured on: a standard error of some 2 %."""

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Of pictures."""

Progress = Callable[[str, int, int], None]


def bench_prior(
    folders: Sequence[Path],
    threads: Sequence[int],
    device: str,
    pictures: Path | None,
    repeats: int,
    progress: Progress,
) -> dict[str, Any]:
    """Times the safety net, the compact prior where its weights are, and exported ``folders``.

    Recall is of each contender's first thread count: how many there are changes no match.

    Raises:
        InputError: a folder is no prior, or there is no picture in ``pictures``.
        AquaFlowError: the device is not there.
    """
    seen = [sea_floor(640, 480)] if pictures is None else pictures_in(pictures)
    contenders = [
        BenchmarkedPrior("classical", "none", 1, make_prior(PriorConfig(kind="classical")))
    ]
    shipped = [SHIPPED] if (SHIPPED / CARD).is_file() else []
    for folder in (*shipped, *folders):
        for precision in _precisions(folder):
            contenders += [_contender(folder, precision, count, device) for count in threads]
    return {
        "machine": machine.describe(),
        "rows": latency_rows(contenders, SIZES, repeats, progress),
        "recall": _recall(contenders, seen, progress),
    }


def _contender(folder: Path, precision: str, threads: int, device: str) -> BenchmarkedPrior:
    config = {
        "kind": "folder", "folder": folder, "device": device, "precision": precision,
        "threads": threads,
    }  # fmt: skip
    prior = make_prior(validate(PriorConfig, config, COMMAND_LINE))
    name = prior.name if folder == SHIPPED else f"{prior.name} in {folder}"
    return BenchmarkedPrior(name, precision, threads, prior)


def _precisions(folder: Path) -> list[str]:
    return ["fp32", "int8"] if INT8_ENCODER in read_card(folder).files else ["fp32"]


def _recall(
    contenders: Sequence[BenchmarkedPrior],
    pictures: Sequence[Picture],  # [H, W, 3] RGB each
    progress: Progress,
) -> dict[str, dict[str, dict[str, float]]]:
    """By contender and level: see ``homography_recall``."""
    first = {f"{c.name} {c.variant}": c for c in reversed(contenders)}
    found: dict[str, dict[str, dict[str, float]]] = {}
    for done, (name, contender) in enumerate(reversed(first.items())):
        progress("recall", done, len(first))
        matcher = matcher_of(contender.prior)
        found[name] = {
            level.name: {
                key: round(value, 4)
                for key, value in homography_recall(matcher, pictures, level, PAIRS).items()
            }
            for level in LEVELS
        }
    progress("recall", len(first), len(first))
    return found


def pictures_in(folder: Path) -> list[Picture]:
    """[H, W, 3] RGB each.

    Raises:
        InputError: there is none.
    """
    paths = sorted(p for p in folder.glob("*") if p.suffix.lower() in SUFFIXES)
    found = [cv2.imread(str(path), cv2.IMREAD_COLOR) for path in paths]
    pictures = [
        np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        for image in found
        if image is not None
    ]
    if not pictures:
        raise InputError(f"there is no picture in {folder}; give a folder of them to --pictures")
    return pictures
