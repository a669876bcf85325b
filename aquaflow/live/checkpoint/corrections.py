"""Corrections that the maps of a checkpoint do not contain yet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from aquaflow.geometry.arrays import Arrays, of_sim3, to_sim3
from aquaflow.live.map_thread import MapCorrection
from aquaflow.mapping.work import MapWork


def serialise_corrections(lacking: Sequence[MapCorrection]) -> tuple[list[dict[str, Any]], Arrays]:
    """Corrections that the maps do not contain yet: facts for JSON, and arrays."""
    facts: list[dict[str, Any]] = []
    arrays: Arrays = {}
    for i, correction in enumerate(lacking):
        merged = {str(source): target for source, target in correction.merged.items()}
        facts.append({"merged": merged})
        arrays[f"lacking{i}.keyframes"] = np.array(list(correction.moves), np.int64)
        arrays[f"lacking{i}.moves"] = of_sim3(list(correction.moves.values()))
    return facts, arrays


def catch_up(
    maps: MapWork,
    lacking: list[dict[str, Any]],
    arrays: Arrays,  # as from serialise_corrections
) -> None:
    """Apply the corrections of :func:`serialise_corrections` to the maps."""
    for i, facts in enumerate(lacking):
        numbers, moves = arrays[f"lacking{i}.keyframes"], arrays[f"lacking{i}.moves"]
        by_keyframe = {int(n): to_sim3(row) for n, row in zip(numbers, moves, strict=True)}
        merged = {int(source): int(target) for source, target in facts["merged"].items()}
        maps.correct(by_keyframe, merged)
