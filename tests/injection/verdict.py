"""Whether a dive with a fault in it ended as it should: what is wrong with it, in words."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .child import HUNG, Ended
from .faults import Kind
from .watch import Moment

MOST_MISSING = 6
"""Frames without a pose that one fault may cost: its own, and those that a start of a map waits
for (``max_waiting`` in dives.py)."""
POOR = 3
ENDED = (0, POOR)
"""Exit codes of a dive that ended; POOR: with warnings, as where a busy machine kept a live dive
from most frames."""
REFUSALS = (1, 70)
"""Exit codes of a command that says why it does not begin; 70: a library failed."""
INTERRUPTED, STOPPED = 130, "aquaflow: stopped"
POSE_FILES = ("trajectory.tum", "camera.yaml")
MAP_FILES = ("map.aqf", "map.ply", "map_clear.ply", "medium.json")


@dataclass(frozen=True)
class Before:
    """What a dive finds of its frames without a fault."""

    rows: frozenset[int] | None
    """Frames that must have a row; None for a live dive, which sees other frames every time."""
    without_pose: frozenset[int]


def frames_of(dive: Path, whole: bool) -> Before:
    """Of a dive without a fault; ``whole`` if every frame of the recording has a row each time."""
    from aquaflow.dive.frames_csv import read_rows

    rows = read_rows(dive / "frames.csv")
    without = frozenset(row.index for row in rows if row.sub_map is None)
    return Before(frozenset(row.index for row in rows) if whole else None, without)


def refused(ended: Ended) -> bool:
    """True if the command said in one sentence why it does not begin, or goes no further."""
    return ended.code in REFUSALS and _says(ended, "aquaflow: ") and "Traceback" not in ended.err


def _says(ended: Ended, start: str) -> bool:
    """True for one sentence of ours, which begins like this."""
    lines = [line for line in ended.err.splitlines() if line.startswith("aquaflow: ")]
    return len(lines) == 1 and lines[0].startswith(start)


def exit_problems(kind: Kind, met: Moment, ended: Ended) -> list[str]:
    """What is wrong with how the command ended; a fault before the first frame may refuse it."""
    if ended.code == HUNG:
        return ["hangs"]
    if "Traceback" in ended.err:
        return [f"traceback: {_last_line(ended.err)}"]
    if ended.code in ENDED:
        return []
    if refused(ended) and (met.phase == "start" or kind in (Kind.FULL, Kind.MEMORY)):
        return []
    if kind is Kind.INTERRUPT and ended.code == INTERRUPTED and _says(ended, STOPPED):
        return []
    return [f"exit {ended.code}: {_last_line(ended.err)}"]


def stopped_empty(kind: Kind, met: Moment, ended: Ended, dive: Path) -> bool:
    """True for a live dive that was interrupted before its first map: it has nothing to write."""
    from aquaflow.base.errors import AquaFlowError
    from aquaflow.dive.frames_csv import read_rows
    from aquaflow.mapping.work import MIN_VIEWS

    if kind is not Kind.INTERRUPT or ended.code != POOR:
        return False
    if met.phase == "start":
        return True
    try:
        rows = read_rows(dive / "frames.csv")
    except AquaFlowError:
        return False  # what is wrong with it is found when the folder is looked at
    return sum(row.sub_map is not None for row in rows) < MIN_VIEWS


def folder_problems(dive: Path, before: Before) -> list[str]:
    """What cannot be read of a finished dive, or is not whole."""
    problems: list[str] = []
    numbers = _metrics(dive, problems)
    stated = json.dumps(numbers.get("failures", []))
    for name in POSE_FILES:
        _try(problems, name, lambda name=name: _read_pose_file(dive / name))
    for name in ("report.html", *MAP_FILES):
        if not (dive / name).is_file() and _is_stated(name, stated):
            continue
        _try(problems, name, lambda name=name: _read_map_file(dive / name))
    _try(problems, "frames.csv", lambda: _check_rows(dive, before))
    return problems


def row_problems(dive: Path) -> list[str]:
    """What cannot be read of the rows of a dive that was stopped."""
    from aquaflow.dive.frames_csv import read_rows

    problems: list[str] = []
    _try(problems, "frames.csv", lambda: read_rows(dive / "frames.csv"))
    return problems


def _metrics(dive: Path, problems: list[str]) -> dict[str, Any]:
    numbers: dict[str, Any] = {}

    def read() -> None:
        text = (dive / "metrics.json").read_text()
        numbers.update(json.loads(text, parse_constant=_no_constant))

    _try(problems, "metrics.json", read)
    return numbers


def _is_stated(name: str, stated: str) -> bool:
    """Whether metrics.json says that the step which writes the file failed."""
    return name in stated


def _read_pose_file(path: Path) -> None:
    from aquaflow.geometry.camera import load_camera
    from aquaflow.lab.evaluation.trajectory_error import read_tum

    if path.suffix == ".yaml":
        load_camera(path)
        return
    trajectory = read_tum(path)
    assert all(np.isfinite(value).all() for value in vars(trajectory).values() if _is_array(value))


def _read_map_file(path: Path) -> None:
    from aquaflow.dive.map_file import read_map_file
    from aquaflow.dive.ply import read_ply
    from aquaflow.render import select_renderer

    if path.suffix == ".html":
        assert path.read_text().rstrip().endswith("</html>"), "cut short"
    elif path.suffix == ".json":
        json.loads(path.read_text(), parse_constant=_no_constant)
    elif path.suffix == ".ply":
        splats = read_ply(path)
        assert all(np.isfinite(value).all() for value in vars(splats).values()), "not finite"
    else:
        mapper = read_map_file(path, select_renderer("tiles", 1))
        for name, tensor in mapper.gaussians.parameters.items():
            assert bool(tensor.isfinite().all()), f"{name} is not finite"
        for view in mapper.views:
            assert np.isfinite(view.T_wc.t).all(), f"the pose of view {view.frame_index}"
            assert np.isfinite(view.T_wc.R).all(), f"the pose of view {view.frame_index}"


def _check_rows(dive: Path, before: Before) -> None:
    from aquaflow.dive.frames_csv import read_rows

    rows = {row.index: row for row in read_rows(dive / "frames.csv")}
    if before.rows is not None:
        assert set(rows) == before.rows, f"rows of {len(rows)} of {len(before.rows)} frames"
    without = {index for index, row in rows.items() if row.sub_map is None} - before.without_pose
    assert len(without) <= MOST_MISSING, f"{len(without)} frames lost: {_why(rows, without)}"
    silent = [index for index in without if not rows[index].reason]
    assert not silent, f"no reason for the frames {silent}"


def _why(rows: dict[int, Any], without: set[int]) -> str:
    return "; ".join(sorted({rows[index].reason for index in without}))


def _try(problems: list[str], name: str, read: Any) -> None:
    try:
        read()
    except Exception as error:
        problems.append(f"{name}: {type(error).__name__}: {error}".splitlines()[0])


def _is_array(value: object) -> bool:
    return isinstance(value, np.ndarray) and np.issubdtype(value.dtype, np.floating)


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} in JSON")


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "(silent)"
