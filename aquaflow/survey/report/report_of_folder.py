"""The report's values, read back from a finished dive's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.errors import InputError, printable, reason_of
from aquaflow.base.errors.regular_file import open_regular_text, read_regular, read_regular_json
from aquaflow.dive.folder import CALIBRATION, MARKER
from aquaflow.dive.frames_csv import FrameRow, read_rows
from aquaflow.dive.from_maps import OVERVIEW
from aquaflow.dive.png import read_png
from aquaflow.dive.trajectory_csv import NAME as PATH_TABLE
from aquaflow.dive.trajectory_csv import PoseRow, read_trajectory_csv
from aquaflow.geometry.camera import load_camera
from aquaflow.survey.coverage import PageView
from aquaflow.survey.coverage.coverage_file import NAME as COVERAGE
from aquaflow.survey.coverage.coverage_file import read_coverage_file
from aquaflow.survey.measure.quantity import Quantity
from aquaflow.survey.measure.reef_files import JSON as REEF
from aquaflow.survey.report import HeldOutExample, MediumCurves, PathPlot, ReefRow, ReportData
from aquaflow.survey.report.dive_measures import measures
from aquaflow.survey.report.report_data import MAX_EXAMPLES, camera_summary
from aquaflow.survey.report.survey_data import left_out, profile
from aquaflow.telemetry.metric_file import read_main, read_metric_file
from aquaflow.telemetry.metric_frame import MetricFrame

FOUND = "found from the dive"
"""In the first line of a calibration that nobody gave."""


def report_of_folder(dive: Path) -> ReportData:
    """What the report of a finished dive shows, but for the quality of single held-out views.

    Raises:
        InputError: a file that every finished dive has is missing or damaged.
    """
    metrics, rows = _json(dive / "metrics.json"), read_rows(dive / MARKER)
    poses = read_trajectory_csv(dive / PATH_TABLE)
    frames, main = read_metric_file(dive), read_main(dive)
    frame = frames.get(main, MetricFrame.unknown())
    path, medium = _path(poses, rows, frames, frame), _medium(dive, frame)
    camera = load_camera(dive / "camera.yaml", inside=True)
    return ReportData(
        name=printable(dive.resolve().name),
        camera=camera_summary(camera, _calibrated(dive)),
        metrics=metrics,
        path=path,
        measures=measures(path, frame, None),
        reef=_reef(dive / REEF, frame),
        timeline=[row.frame_class for row in rows],
        examples=_examples(dive),
        medium=medium,
        coverage=_coverage(dive, main),
        overview=_bytes(dive / OVERVIEW),
        profile=profile(poses, frame),
        left_out=left_out(rows),
        stages=metrics.get("stage_ms", {}),
        warnings=metrics.get("warnings", []),
        notes=metrics.get("notes", []),
    )


def _json(path: Path) -> dict[str, Any]:
    try:
        content = read_regular_json(path)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {reason_of(error)}; map the dive again") from error
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no object; map the dive again")
    return content


def _path(
    poses: list[PoseRow],
    rows: list[FrameRow],
    frames: dict[int, MetricFrame],
    frame: MetricFrame,
) -> PathPlot:
    classes = {row.index: row.frame_class for row in rows}
    own = [frames.get(n, MetricFrame.unknown()) for n in {row.sub_map for row in poses}]
    level = bool(own) and all(each.level for each in own)
    return PathPlot(
        np.array([(row.x, row.y, row.z) for row in poses]).reshape(-1, 3),
        [classes.get(row.index, "common") for row in poses],
        [row.sub_map for row in poses],
        unit=frame.unit,
        up=frame.north if level else "",
        depth_known=frame.depth_known,
        placed=level and all(each.metric for each in own),
    )


def _medium(dive: Path, frame: MetricFrame) -> MediumCurves | None:
    content = _json(dive / "medium.json")
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
        raise InputError(f"{dive / 'medium.json'} is damaged; map the dive again") from error
    return MediumCurves(beta, b, B_inf, B_res, d, *span, unit=frame.unit)


def _reef(path: Path, frame: MetricFrame) -> list[ReefRow]:
    """Empty where there are none, or in another unit than the rest of the dive."""
    if not path.is_file():
        return []
    content = _json(path)
    try:
        if content["unit"] != frame.unit:
            return []
        numbers = [_reef_row(each) for each in content["numbers"].values()]
        missing = content["missing"].items()
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} is damaged; map the dive again") from error
    return numbers + [ReefRow(what, "unknown", "", why) for what, why in missing]


def _reef_row(number: dict[str, Any]) -> ReefRow:
    """Raises KeyError, TypeError or ValueError for what is none."""
    value, sigma, low, high = (
        float(number[key]) for key in ("value", "sigma", "low_95", "high_95")
    )
    words = Quantity(value, sigma, low, high, str(number["unit"])).in_words()
    return ReefRow(number["label"], words, f"{low:.4g} to {high:.4g}", number["meaning"])


def _coverage(dive: Path, main: int) -> PageView | None:
    path = dive / COVERAGE
    return read_coverage_file(path).get(main) if path.exists() else None


def _bytes(path: Path) -> bytes | None:
    return read_regular(path) if path.is_file() else None


def _calibrated(dive: Path) -> bool:
    try:
        with open_regular_text(dive / CALIBRATION) as stream:
            return FOUND not in stream.readline()
    except (OSError, ValueError):
        return False


def _examples(dive: Path) -> list[HeldOutExample]:
    """Some held-out views, spread over the dive; one whose pictures are damaged is left out."""
    real = sorted((dive / "heldout").glob("*_real.png"))
    chosen = np.linspace(0, len(real) - 1, min(len(real), MAX_EXAMPLES)).round().astype(int)
    examples = []
    for path in (real[i] for i in chosen):
        stem = path.name.removesuffix("_real.png")
        others = [path.with_name(f"{stem}_{name}.png") for name in ("rendered", "restored")]
        try:
            pictures = [
                read_png(each, folders=1) if each.exists() else None for each in (path, *others)
            ]
        except (OSError, ValueError):
            continue
        first, rendered, restored = pictures
        if first is not None and rendered is not None:
            caption = f"frame {stem.lstrip('0') or '0'}"
            examples.append(HeldOutExample(caption, first, rendered, restored))
    return examples
