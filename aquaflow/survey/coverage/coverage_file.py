"""coverage.npz: the plan views of a dive, for viewers and other programs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError, reason_of
from aquaflow.base.errors.regular_file import LARGEST_JSON_BYTES
from aquaflow.base.storage.archive import UNREADABLE, read_arrays_of
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.survey.coverage.classes import CoverageClass
from aquaflow.survey.coverage.page_view import PageView
from aquaflow.survey.coverage.plan import CoveragePlan
from aquaflow.survey.coverage.raster import GridFrame
from aquaflow.survey.coverage.survey_lines import LineState, Suggestion, SurveyLine

NAME = "coverage.npz"
"""In a dive's folder (docs/formats.md#coverage)."""
MOST_BYTES = 1 << 27
"""Of all arrays together: a sub-map's plan views take at most 14 MB, most of them far less."""
VALUES = "values"
"""The array that holds what is no array, as JSON."""


def write_coverage_file(path: Path, views: Mapping[int, PageView]) -> None:
    """Write the plan views by sub-map.

    Raises:
        InputError: the file cannot be written.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    values = {}
    for number, view in views.items():
        plan, state = view.plan, view.state
        arrays |= {
            f"{number}.{name}": array
            for name, array in (
                ("classes", plan.classes), ("views", plan.views), ("nearest", plan.nearest),
                ("directions", plan.directions), ("to_page", view.to_page), ("path", view.path),
                ("R_gm", plan.frame.R_gm),
            )
        }  # fmt: skip
        values[str(number)] = {
            "corner": plan.corner, "cell": plan.cell, "limit": plan.limit,
            "grid_cell": plan.frame.cell, "reference": plan.frame.reference,
            "cells": {seen.name: count for seen, count in plan.cells.items()},
            "scale": view.scale, "unit": view.unit,
            "seen": view.seen, "right": view.right, "up": view.up,
            "swath": state.swath, "overlap": state.overlap,
            "lines": [_as_json(asdict(line)) for line in state.lines],
            "next_line": None if state.suggestion is None else _as_json(asdict(state.suggestion)),
        }  # fmt: skip
    arrays[VALUES] = np.frombuffer(json.dumps(values).encode(), np.uint8)
    with atomic_write(path) as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def read_coverage_file(path: Path) -> dict[int, PageView]:
    """The plan views by sub-map.

    Raises:
        InputError: the file is missing, damaged or of something else.
    """
    try:
        arrays = read_arrays_of(path, most_bytes=MOST_BYTES)
        text = arrays.pop(VALUES).tobytes()
        if len(text) > LARGEST_JSON_BYTES:
            raise DamagedError("its values are longer than a dive's can be")
        values = json.loads(text)
        return {int(number): _view(int(number), each, arrays) for number, each in values.items()}
    except FileNotFoundError as error:
        raise InputError(f"{path} is missing; map the dive again for its coverage") from error
    except (*UNREADABLE, AttributeError) as error:
        said = f" ({reason_of(error)})" if isinstance(error, (OSError, DamagedError)) else ""
        raise InputError(
            f"{path} is no coverage of a dive, or damaged{said}; map it again"
        ) from error


def _view(
    number: int,
    values: dict[str, Any],
    arrays: Mapping[str, npt.NDArray[Any]],  # all of the file
) -> PageView:
    def array(name: str) -> npt.NDArray[Any]:
        return arrays[f"{number}.{name}"]

    x, y = values["corner"]
    plan = CoveragePlan(
        GridFrame(array("R_gm"), values["grid_cell"], values["reference"]), (x, y), values["cell"],
        array("classes"), array("views"), array("directions"), array("nearest"), values["limit"],
        {CoverageClass[name]: int(count) for name, count in values["cells"].items()},
    )  # fmt: skip
    lines = [
        SurveyLine(np.array(each["start"]), np.array(each["end"]), each["first"], each["last"])
        for each in values["lines"]
    ]
    line = values["next_line"]
    found = line and Suggestion(np.array(line["start"]), np.array(line["end"]), line["gain"])
    return PageView(
        number, plan, array("to_page"), values["scale"], values["unit"], values["seen"],
        values["right"], values["up"], array("path"),
        LineState(lines, values["swath"], values["overlap"], found),
    )  # fmt: skip


def _as_json(values: dict[str, Any]) -> dict[str, Any]:
    """For JSON."""
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in values.items()
    }
