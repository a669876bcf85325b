"""The values of report.html: of a dive that goes on, that ends, or that ended long ago."""

from __future__ import annotations

from typing import Any

import numpy as np

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.medium import NAME as MEDIUM
from aquaflow.survey.coverage import PageView
from aquaflow.survey.coverage.coverage_file import NAME as COVERAGE
from aquaflow.survey.coverage.coverage_file import read_coverage_file
from aquaflow.survey.measure.quantity import Quantity
from aquaflow.survey.measure.reef_files import JSON as REEF
from aquaflow.survey.report import (
    CameraSummary,
    HeldOutExample,
    MediumCurves,
    PathPlot,
    ReefRow,
    ReportData,
)
from aquaflow.survey.report.dive_measures import measures
from aquaflow.survey.report.survey_data import left_out, profile

OVERVIEW = "overview.png"
"""The map from straight above, in a dive's folder."""
MAX_EXAMPLES = 6
"""Held-out frames shown, spread evenly over the dive."""


def report_of(dive: Dive) -> ReportData:
    """What the report of ``dive`` shows.

    Raises:
        InputError, ConfigError: a file that every dive has is missing or damaged.
    """
    metrics, frame = dive.metrics, dive.frame
    rows = sorted(dive.frames, key=lambda row: row.index)
    path, medium = _path(dive), _medium(dive)
    return ReportData(
        name=dive.name,
        camera=_camera(dive),
        metrics=metrics,
        path=path,
        measures=measures(path, frame, medium),
        reef=[] if dive.is_going_on else _reef(dive),
        timeline=[row.frame_class for row in rows],
        examples=_examples(dive),
        medium=medium,
        coverage=_coverage(dive),
        overview=None if dive.is_going_on else _overview(dive),
        profile=profile(dive.poses, frame),
        left_out=left_out(rows),
        stages=metrics.get("stage_ms", {}),
        warnings=metrics.get("warnings", []),
        notes=metrics.get("notes", []),
    )


def _camera(dive: Dive) -> CameraSummary:
    camera = dive.camera
    source = "calibrated" if dive.is_calibrated else "refined"
    return CameraSummary(camera.width, camera.height, camera.fx, source)  # type: ignore[arg-type]


def _path(dive: Dive) -> PathPlot:
    rows, frame = dive.poses, dive.frame
    classes = {row.index: row.frame_class for row in dive.frames}
    own = [dive.frame_of(number) for number in {row.sub_map for row in rows}]
    level = bool(own) and all(each.level for each in own)
    return PathPlot(
        np.array([(row.x, row.y, row.z) for row in rows]).reshape(-1, 3),
        [classes.get(row.index, "common") for row in rows],
        [row.sub_map for row in rows],
        unit=frame.unit,
        up=frame.north if level else "",
        depth_known=frame.depth_known,
        placed=level and all(each.metric for each in own),
    )


def _medium(dive: Dive) -> MediumCurves | None:
    content = dive.medium_facts
    if not content.get("active"):
        return None
    try:
        scattered = content["backscatter"]
        beta, b, B_inf, B_res, d = (
            (float(r), float(g), float(blue))
            for r, g, blue in (
                content["attenuation_per_unit"], scattered["b"], scattered["B_inf"],
                scattered["B_res"], scattered["d"],
            )
        )  # fmt: skip
        span = float(content["range_p5"]), float(content["range_p95"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{dive.file(MEDIUM)} is damaged; map the dive again") from error
    return MediumCurves(beta, b, B_inf, B_res, d, *span, unit=dive.frame.unit)


def _reef(dive: Dive) -> list[ReefRow]:
    """Empty where there are none, or in another unit than the rest of the dive."""
    if not (content := dive.facts(REEF)):
        return []
    try:
        if content["unit"] != dive.frame.unit:
            return []
        numbers = [_reef_row(each) for each in content["numbers"].values()]
        missing = content["missing"].items()
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{dive.file(REEF)} is damaged; map the dive again") from error
    return numbers + [ReefRow(what, "unknown", "", why) for what, why in missing]


def _reef_row(number: dict[str, Any]) -> ReefRow:
    """Raises KeyError, TypeError or ValueError for what is none."""
    value, sigma, low, high = (
        float(number[key]) for key in ("value", "sigma", "low_95", "high_95")
    )
    words = Quantity(value, sigma, low, high, str(number["unit"])).in_words()
    return ReefRow(number["label"], words, f"{low:.4g} to {high:.4g}", number["meaning"])


def _coverage(dive: Dive) -> PageView | None:
    return read_coverage_file(dive.file(COVERAGE)).get(dive.main) if dive.has(COVERAGE) else None


def _overview(dive: Dive) -> bytes | None:
    return dive.file(OVERVIEW).read_bytes() if dive.has(OVERVIEW) else None


def _examples(dive: Dive) -> list[HeldOutExample]:
    """Some held-out views, spread over the dive; one whose pictures are damaged is left out."""
    views = dive.held_out
    chosen = np.linspace(0, len(views) - 1, min(len(views), MAX_EXAMPLES)).round().astype(int)
    examples = []
    for view in (views[i] for i in chosen):
        try:
            examples.append(
                HeldOutExample(
                    f"frame {view.frame_index}", view.real, view.rendered, view.restored,
                    view.psnr, view.ssim, view.confidence,
                )
            )  # fmt: skip
        except InputError:
            continue
    return examples
