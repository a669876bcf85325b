"""Shortcomings of a finished dive as sentences with remedies; printed before the results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from aquaflow.config import Config
from aquaflow.config.mapping import InsertionConfig, OptimiserConfig
from aquaflow.config.stage import Stage
from aquaflow.dive.frames_csv import FrameRow

LEAST_POSED_SHARE = 0.5
"""Of all frames; a dive with fewer poses is not what its user asked for."""


def shortcomings(config: Config, rows: Sequence[FrameRow], gaussians: int) -> list[str]:
    """Sentences for a dive with the frames ``rows`` and a map of so many Gaussians."""
    found = []
    posed = sum(row.sub_map is not None for row in rows)
    if posed < LEAST_POSED_SHARE * len(rows):
        found.append(
            f"only {posed} of {len(rows)} frames have a pose{_most_common_reason(rows)}; take "
            "frames closer together (a smaller --every), give a calibration (--calib), and see "
            "frames.csv for each frame"
        )
    if config.mapping.enabled and gaussians == 0:
        found.append(f"the map is empty: it ends with 0 Gaussians; {_what_to_do(config)}")
    return found


def _most_common_reason(rows: Sequence[FrameRow]) -> str:
    reasons = Counter(row.reason for row in rows if row.sub_map is None and row.reason)
    if not reasons:
        return ""
    reason, count = reasons.most_common(1)[0]
    return f" ({count} of the others: {reason})"


def _what_to_do(config: Config) -> str:
    changed = [
        *_changed("insertion", config.mapping.insertion, InsertionConfig()),
        *_changed("optimiser", config.mapping.optimiser, OptimiserConfig(), "prune_"),
    ]
    if changed:
        return f"{' and '.join(changed)}: set it back"
    return "the camera must move sideways, over texture, for depths to be known"


def _changed(name: str, asked: Stage, usual: Stage, prefix: str = "") -> list[str]:
    """Settings of a stage of the map that are not the default, those called ``prefix``..."""
    return [
        f"mapping.{name}.{key} is {getattr(asked, key)}, by default {getattr(usual, key)}"
        for key in type(usual).model_fields
        if key.startswith(prefix) and getattr(asked, key) != getattr(usual, key)
    ]
