"""The results of ``aquaflow lab prior bench`` and ``prior compare`` on a terminal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from scipy.ndimage import map_coordinates

from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import epipolar_distances, relative_pose
from aquaflow.lab.evaluation.matching import WITHIN_PX
from aquaflow.lab.prior_bench.pair import FoundMatches, KnownPair
from aquaflow.prior.contract import Float

WORK = {"tracked": "near its prediction", "found": "moved far, none expected"}
"""What a pair of pictures asks of a prior."""


def print_result(result: dict[str, Any], console: Console) -> None:
    """One line for each row, then what the machine was."""
    table = Table(title="one frame, matching included")
    for column in ("prior", "weights", "threads", "size", "frame"):
        table.add_column(column)
    for column in ("ms", "ms of processor"):
        table.add_column(column, justify="right")
    for row in result["rows"]:
        size = f"{row['width']} x {row['height']}"
        names = (row["prior"], row["variant"], str(row["threads"]), size, WORK[row["work"]])
        table.add_row(*names, f"{row['ms']:.1f}", f"{row['cpu_ms']:.1f}")
    console.print(table)
    console.print(_recall_table(result["recall"]))
    machine = result["machine"]
    console.print(
        f"{machine['processor']}, {machine['cores']} cores, load {machine['load']}",
        highlight=False,
    )


def _recall_table(recall: dict[str, dict[str, dict[str, float]]]) -> Table:
    table = Table(title="matches found within 2 px, pictures turned, moved and relit")
    table.add_column("prior")
    levels = list(next(iter(recall.values()), {}))
    for level in levels:
        table.add_column(level, justify="right")
    for name, by_level in recall.items():
        table.add_row(name, *(f"{by_level[level]['recall']:.3f}" for level in levels))
    return table


COMPARED = (
    ("recall", "recall", ".3f"),
    ("precision", "within 2 px", ".3f"),
    ("median_px", "median px", ".2f"),
    ("matches", "matches", "d"),
    ("rotation_deg", "rotation °", ".2f"),
    ("direction_deg", "direction °", ".1f"),
    ("picture_cpu_ms", "ms/picture", ".0f"),
    ("pair_cpu_ms", "ms/pair", ".0f"),
)
"""Key, title and format of the columns of a comparison."""
COMPARISON_NOTES = (
    "recall: textured pixels that b shows and that are matched within 2 px, of dense methods; "
    "within 2 px: of the matches, from the true place, or * from the true epipolar line, where a "
    "wrong match may lie by chance; rotation and direction: error of the pose from the matches.",
    "Times are of the processor. A network looks at a picture once, SIFT only where flow fails, "
    "then in the pair's time.",
)
"""What the titles leave open."""


def print_comparison(result: dict[str, Any], console: Console) -> None:
    """One line for each method on each kind of pairs, and what could not run."""
    table = Table(title="the same pairs, nothing predicted")
    for column in ("pairs", "method"):
        table.add_column(column)
    for _, title, _ in COMPARED:
        table.add_column(title, justify="right")
    before = None
    for row in result["rows"]:
        if before not in (None, row["pairs"]):
            table.add_section()
        name = "" if row["pairs"] == before else f"{row['pairs']} ({row['count']})"
        before = row["pairs"]
        cells = (_cell(row, key, form) for key, _, form in COMPARED)
        table.add_row(name, row["method"], *cells)
    console.print(table)
    for sentence in (*result["missing"], *COMPARISON_NOTES):
        console.print(sentence, highlight=False, markup=False)


def _cell(row: dict[str, Any], key: str, form: str) -> str:
    if row[key] is None:
        return "-"
    by_line = row["judged_by"] == "line" and key in ("precision", "median_px")
    return format(row[key], form) + ("*" if by_line else "")


# --------------------------------------------------------------------------------------------------
# How right the matches of one pair are, and the relative pose that follows from them.

Errors = npt.NDArray[np.float64]

POSE_SAMPLES = 2000
"""Matches that the pose is estimated from, evenly over those found."""
WHOLLY = 0.999
"""Of the four pixels around a place: all are visible."""


@dataclass(frozen=True)
class PairFigures:
    """Figures of one method on one pair."""

    matches: int
    precision: float
    """Share of the matches within 2 px of the truth, or of the true epipolar line."""
    median_px: float
    """Median distance from it; NaN without a match."""
    recall: float | None
    """Share of the textured, visible pixels that have a right match; None for a sparse method, or
    where only epipolar lines are known."""
    rotation_deg: float | None
    """Error of the pose from the matches; infinite where none follows, None without a true one."""
    direction_deg: float | None
    """Of its translation's direction, likewise."""


def figures_of(pair: KnownPair, found: FoundMatches) -> PairFigures:
    """The pair's figures for the matches of one method."""
    if pair.truth is not None and pair.visible is not None:
        errors = _pixel_errors(pair, found)
    else:
        errors = _line_errors(pair, found)
    right = errors < WITHIN_PX
    known = errors[np.isfinite(errors)]
    rotation, direction = _pose_errors(pair, found)
    return PairFigures(
        len(errors),
        float(right.mean()) if len(errors) else 0.0,
        float(np.median(known)) if len(known) else math.nan,
        _recall(pair, found, right),
        rotation,
        direction,
    )


def _pixel_errors(pair: KnownPair, found: FoundMatches) -> Errors:
    """[M] px; infinite where b does not show the true match."""
    assert pair.truth is not None
    assert pair.visible is not None
    if len(found.pixels_a) == 0:
        return np.zeros(0)
    column_row = found.pixels_a.astype(np.float64) - 0.5
    there = np.stack([_at(pair.truth[..., axis], column_row) for axis in (0, 1)], -1)
    shown = _at(pair.visible.astype(np.float32), column_row) > WHOLLY
    errors = np.linalg.norm(found.pixels_b.astype(np.float64) - there, axis=-1)
    return np.where(shown, errors, np.inf)


def _at(
    field: Float,  # [H, W]
    column_row: Errors,  # [M, 2]
) -> Errors:
    """[M] bilinear values; OpenCV's remap takes 32,767 at most."""
    return np.asarray(map_coordinates(field, column_row.T[::-1], order=1, mode="nearest"))


def _line_errors(pair: KnownPair, found: FoundMatches) -> Errors:
    """[M] px from the true epipolar lines."""
    assert pair.T_ba is not None
    rays_a = pair.camera_a.unproject(found.pixels_a.astype(np.float64))
    rays_b = pair.camera_b.unproject(found.pixels_b.astype(np.float64))
    return pair.camera_b.fx * epipolar_distances(rays_a, rays_b, pair.T_ba)


def _recall(
    pair: KnownPair,
    found: FoundMatches,
    right: npt.NDArray[np.bool_],  # [M]
) -> float | None:
    if pair.visible is None or found.textured is None:
        return None
    wanted = pair.visible & found.textured
    cells = np.floor(found.pixels_a[right]).astype(int)
    hits = np.zeros_like(wanted)
    hits[cells[:, 1], cells[:, 0]] = True
    return float((hits & wanted).sum() / max(wanted.sum(), 1))


def _pose_errors(pair: KnownPair, found: FoundMatches) -> tuple[float | None, float | None]:
    """Degrees of rotation and of the translation's direction."""
    if pair.T_ba is None:
        return None, None
    step = max(1, len(found.pixels_a) // POSE_SAMPLES)
    a, b = (p[::step].astype(np.float64) for p in (found.pixels_a, found.pixels_b))
    T_ba = relative_pose(a, b, pair.camera_a, pair.camera_b)
    if T_ba is None:
        return math.inf, math.inf
    return _rotation_deg(T_ba, pair.T_ba), _direction_deg(T_ba, pair.T_ba)


def _rotation_deg(one: Sim3, other: Sim3) -> float:
    cosine = (np.trace(one.R.T @ other.R) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _direction_deg(one: Sim3, other: Sim3) -> float:
    cosine = one.t @ other.t / max(float(np.linalg.norm(one.t) * np.linalg.norm(other.t)), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
