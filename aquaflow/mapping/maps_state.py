"""All maps of a dive as facts and arrays, for a checkpoint; their pictures are stored apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from aquaflow.base.errors.failures import Failures
from aquaflow.geometry.arrays import Arrays, of_camera, of_sim3, prefixed, to_camera, to_sim3, under
from aquaflow.mapping import state
from aquaflow.mapping.mapper import Mapper
from aquaflow.mapping.state import NO_PIXELS
from aquaflow.render.contract import Renderer
from aquaflow.render.views import View


def serialised(
    mappers: Mapping[int, Mapper], held_out: Mapping[int, Sequence[View]]
) -> tuple[dict[str, Any], Arrays]:
    """Facts for JSON, and arrays, which are copies; both arguments are by sub-map."""
    facts: dict[str, Any] = {"maps": {}, "held_out": {}}
    arrays: Arrays = {}
    for number, mapper in mappers.items():
        facts["maps"][str(number)], parts = state.serialise(mapper, optimiser=True)
        arrays |= prefixed(f"map{number}", parts)
    for number, views in held_out.items():
        facts["held_out"][str(number)], parts = _held_out(views)
        arrays |= prefixed(f"held_out{number}", parts)
    return facts, arrays


def restored(
    facts: dict[str, Any],
    arrays: Arrays,  # as from serialised
    renderer: Renderer,
    failures: Failures,
) -> tuple[dict[int, Mapper], dict[int, list[View]]]:
    """Maps and held-out views by sub-map, as they were serialised, without their pictures.

    Raises:
        KeyError, ValueError, TypeError, RuntimeError: this is no such checkpoint.
    """
    mappers = {
        int(number): state.deserialise(values, under(f"map{number}", arrays), renderer, failures)
        for number, values in facts["maps"].items()
    }
    held_out = {
        int(number): _read_held_out(values, under(f"held_out{number}", arrays))
        for number, values in facts["held_out"].items()
    }
    return mappers, held_out


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
