"""Serialisation of a dive's maps for a checkpoint; restoring them with their pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from aquaflow.mapping import state
from aquaflow.mapping.maps import Maps
from aquaflow.mapping.state import NO_PIXELS
from aquaflow.mapping.views import View
from aquaflow.service.map_thread import MapCorrection
from aquaflow.storage.arrays import Arrays, of_camera, of_sim3, prefixed, to_camera, to_sim3, under


def serialise(maps: Maps) -> tuple[dict[str, Any], Arrays]:
    """Facts for JSON, and arrays, which are copies."""
    facts: dict[str, Any] = {"maps": {}, "held_out": {}}
    arrays: Arrays = {}
    for number, mapper in maps.mappers.items():
        facts["maps"][str(number)], parts = state.serialise(mapper, optimiser=True)
        arrays |= prefixed(f"map{number}", parts)
    for number, views in maps.held_out.items():
        facts["held_out"][str(number)], parts = _held_out(views)
        arrays |= prefixed(f"held_out{number}", parts)
    return facts, arrays


def deserialise(
    maps: Maps,
    facts: dict[str, Any],
    arrays: Arrays,  # as from serialise
) -> None:
    """Restore new ``maps`` to the state of the serialised ones.

    A view whose file was lost is left out; the Gaussians that it brought stay.

    Raises:
        KeyError, ValueError, TypeError, RuntimeError: this is no such checkpoint.
    """
    for number, values in facts["maps"].items():
        parts = under(f"map{number}", arrays)
        mapper = state.deserialise(values, parts, maps.renderer, maps.failures)
        mapper.views = maps.views.restore(mapper.views)
        maps.mappers[int(number)] = mapper
    for number, values in facts["held_out"].items():
        views = _read_held_out(values, under(f"held_out{number}", arrays))
        maps.held_out[int(number)] = maps.views.restore(views)


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
    maps: Maps,
    lacking: list[dict[str, Any]],
    arrays: Arrays,  # as from serialise_corrections
) -> None:
    """Apply the corrections of :func:`serialise_corrections` to the maps."""
    for i, facts in enumerate(lacking):
        numbers, moves = arrays[f"lacking{i}.keyframes"], arrays[f"lacking{i}.moves"]
        by_keyframe = {int(n): to_sim3(row) for n, row in zip(numbers, moves, strict=True)}
        merged = {int(source): int(target) for source, target in facts["merged"].items()}
        maps.correct(by_keyframe, merged)


def _held_out(views: Sequence[View]) -> tuple[list[dict[str, Any]], Arrays]:
    """What was never learned from has a camera and a pose, and no more."""
    cameras = list(dict.fromkeys(view.camera for view in views))
    numbers = [(v.frame_index, v.keyframe, v.robust, cameras.index(v.camera)) for v in views]
    arrays = {
        "numbers": np.array(numbers, np.int64).reshape(-1, 4),
        "poses": of_sim3([view.T_wc for view in views]),
    }
    return [of_camera(camera) for camera in cameras], arrays


def _read_held_out(
    cameras: list[dict[str, Any]],
    arrays: Arrays,  # as from _held_out
) -> list[View]:
    known = [to_camera(values) for values in cameras]
    rows = zip(arrays["numbers"].tolist(), arrays["poses"], strict=True)
    return [
        View(index, NO_PIXELS, known[camera], to_sim3(pose), keyframe, bool(robust))
        for (index, keyframe, robust, camera), pose in rows
    ]
