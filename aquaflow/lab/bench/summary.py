"""Repeated runs as one line: medians and their spread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from aquaflow.lab.evaluation.water_peers.contract import NAMES

Row = dict[str, Any]


@dataclass(frozen=True)
class Spread:
    """The median of repeated runs, and half the distance from the lowest to the highest."""

    median: float
    half_range: float
    runs: int

    def text(self, form: str) -> str:
        """The median in the format ``form``, with half the range where there are several runs."""
        shown = format(self.median, form)
        return shown if self.runs < 2 else f"{shown} ± {format(self.half_range, form)}"


@dataclass(frozen=True)
class Column:
    """One number of a run: its heading, how to read it from a row, how to write it."""

    title: str
    value: Callable[[Row], float | None]
    form: str


@dataclass(frozen=True)
class SummaryLine:
    """All repeats of one contender on one scene."""

    scene: str
    contender: str
    rows: list[Row]

    @property
    def failures(self) -> list[str]:
        """Why runs failed, one sentence each."""
        return [row["failed"] for row in self.rows if row["failed"]]

    def spread(self, column: Column) -> Spread | None:
        """Spread of the runs that did not fail; None if none has a value."""
        values = [column.value(row) for row in self.rows if not row["failed"]]
        known = [value for value in values if value is not None]
        if not known:
            return None
        return Spread(median(known), (max(known) - min(known)) / 2.0, len(known))

    def cell(self, column: Column) -> str:
        """The text of the cell in ``column``; - without a value."""
        found = self.spread(column)
        return "-" if found is None else found.text(column.form)


def contender_of(row: Row) -> str:
    """The peer's name, or the preset's."""
    return str(row["peer"] or row["preset"])


def lines_of(rows: Sequence[Row]) -> list[SummaryLine]:
    """One line for each scene and contender; scenes in the order of running, peers last."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    lines = []
    for scene in scenes:
        here = [row for row in rows if row["scene"] == scene]
        first_seen = list(dict.fromkeys(contender_of(row) for row in here))
        for name in sorted(first_seen, key=_rank):
            lines.append(
                SummaryLine(scene, name, [row for row in here if contender_of(row) == name])
            )
    return lines


def _rank(contender: str) -> tuple[int, str]:
    known = ("fast", "balanced", "accurate")
    return (known.index(contender) if contender in known else len(known), contender)


def attenuation_error_pct(row: Row) -> float | None:
    """Mean over the channels of |recovered / true - 1| in percent."""
    error = row["medium_error"]
    ratios = [] if error is None else [r for r in error["attenuation_ratio"] if r is not None]
    return 100.0 * sum(abs(r - 1.0) for r in ratios) / len(ratios) if ratios else None


def _part(key: str, part: str) -> Callable[[Row], float | None]:
    return lambda row: None if row[key] is None else row[key][part]


def _number(key: str) -> Callable[[Row], float | None]:
    return lambda row: row[key]


def _percent_posed(row: Row) -> float | None:
    return 100.0 * row["tracked"] / row["frames"] if row["frames"] else None


TOTAL_MS = Column("ms/frame", _part("ms_per_frame", "total"), ".0f")
ATE_PCT = Column("ATE %", lambda row: row["ate_pct_sim3"], ".3f")
PSNR = Column("PSNR dB", lambda row: row["psnr"], ".2f")
COLUMNS = (
    Column("posed %", _percent_posed, ".0f"),
    TOTAL_MS,
    Column("p50", _part("ms_per_frame", "p50"), ".0f"),
    Column("p95", _part("ms_per_frame", "p95"), ".0f"),
    Column("first pose s", lambda row: row["time_to_first_pose_s"], ".2f"),
    ATE_PCT,
    Column("RPE %", _part("rpe", "translation_pct"), ".2f"),
    PSNR,
    Column("as tracked dB", _number("psnr_as_tracked"), ".2f"),
    Column("SSIM", lambda row: row["ssim"], ".3f"),
    Column("FLIP", _number("flip"), ".3f"),
    Column("depth %", lambda row: _times_100(row["depth_absrel"]), ".1f"),
    Column("water %", attenuation_error_pct, ".0f"),
    Column("hue °", lambda row: row["hue_shift_deg"], ".1f"),
    Column("restored dB", _number("restored_psnr"), ".1f"),
    Column("raw dB", _number("raw_psnr"), ".1f"),
    *(
        Column(f"{title} dB", _number(f"restored_psnr_{key}"), ".1f")
        for key, title in NAMES.items()
    ),
    Column("Gaussians", lambda row: row["gaussians"], ".0f"),
    Column("MB", lambda row: row["peak_rss_mb"], ".0f"),
    Column("GPU MB", _number("gpu_mb"), ".0f"),
)
"""Columns of the table; the three above are the axes of the picture too."""
NOTES = (
    "ms/frame is the whole run over its frames, refining included; p50 and p95 are of one frame "
    "while frames come in. Peers find poses only; AquaFlow's time holds the map too.",
    "ATE is after Sim(3) alignment, in percent of the path; RPE in percent of a step; depth and "
    "water are the mean relative errors of held-out ranges and of the attenuation.",
    "hue is how far restoring turns the hue of what is nearest, in degrees of CIELAB.",
    "restored is the PSNR of held-out views without water against the scene without water; raw, "
    "Sea-thru, UDCP and grey world are the camera's pictures of the same views, as they are and "
    "restored by published methods; - means that there is no truth, or no such thing.",
)
"""Printed below the table: what its titles leave open."""


def _times_100(value: float | None) -> float | None:
    return None if value is None else 100.0 * value
