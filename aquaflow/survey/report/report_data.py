"""The values of report.html, from a finished run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from aquaflow.dive.frames_csv import FrameRow
from aquaflow.dive.held_out_example import HeldOut
from aquaflow.dive.metric_outputs import MetricOutputs
from aquaflow.dive.path_rows import path_rows
from aquaflow.dive.results import WaterSummary, largest_sub_map
from aquaflow.geometry.similarity import Sim3
from aquaflow.slam import Slam
from aquaflow.survey.coverage import PageView
from aquaflow.survey.measure.reef_numbers import ReefNumbers
from aquaflow.survey.report import CameraSummary, HeldOutExample, MediumCurves, PathPlot, ReportData
from aquaflow.survey.report.dive_measures import measures, reef_rows
from aquaflow.survey.report.survey_data import left_out, profile
from aquaflow.tracking.frames import FrameClass, Tracked
from aquaflow.types import CameraModel, Dropped

MAX_EXAMPLES = 6
"""Held-out frames shown, spread evenly over the dive."""


def report_data(
    name: str,
    slam: Slam,
    results: list[Tracked],
    dropped: list[Dropped],
    frames: Sequence[FrameRow],
    poses: dict[int, Sim3],
    held_out: list[HeldOut],
    water: WaterSummary | None,
    outputs: MetricOutputs,
    metrics: dict[str, Any],
    notes: list[str],
    reef: ReefNumbers | None,
    calibrated: bool,
    coverage: PageView | None = None,
    overview: bytes | None = None,
) -> ReportData:
    """Everything the report shows; ``poses`` are T_nc, held-out ranges and water in n's unit."""
    frame = outputs.frame(largest_sub_map(results))
    path = _path(results, poses, outputs)
    rows = path_rows(outputs, results, poses)
    return ReportData(
        name=name,
        camera=camera_summary(_camera(slam), calibrated),
        metrics=metrics,
        path=path,
        measures=measures(path, frame, water),
        reef=reef_rows(reef),
        timeline=_timeline(results, dropped),
        examples=_examples(held_out),
        medium=medium_curves(water, frame.unit),
        coverage=coverage,
        overview=overview,
        profile=profile(rows, frame),
        left_out=left_out(frames),
        stages=metrics["stage_ms"],
        warnings=metrics["warnings"],
        notes=notes,
    )


def _camera(slam: Slam) -> CameraModel:
    camera = slam.tracker.camera
    assert camera is not None
    return camera


def camera_summary(camera: CameraModel, calibrated: bool) -> CameraSummary:
    """The camera of the mapped pictures."""
    source = "calibrated" if calibrated else "refined"
    return CameraSummary(camera.width, camera.height, camera.fx, source)  # type: ignore[arg-type]


def _path(results: list[Tracked], poses: dict[int, Sim3], outputs: MetricOutputs) -> PathPlot:
    posed = sorted(
        (tracked for tracked in results if tracked.T_wc is not None),
        key=lambda tracked: tracked.frame.index,
    )
    frame = outputs.frame(largest_sub_map(results))
    frames = [outputs.frame(sub_map) for sub_map in {tracked.sub_map for tracked in posed}]
    level = bool(frames) and all(each.level for each in frames)
    return PathPlot(
        np.array([poses[tracked.frame.index].t for tracked in posed]),
        [tracked.frame_class.value for tracked in posed],
        [tracked.sub_map for tracked in posed],
        unit=frame.unit,
        up=frame.north if level else "",
        depth_known=frame.depth_known,
        placed=level and all(each.metric for each in frames),
    )


def _timeline(results: list[Tracked], dropped: list[Dropped]) -> list[str]:
    classes = {tracked.frame.index: tracked.frame_class.value for tracked in results}
    classes |= {frame.index: FrameClass.DROPPED.value for frame in dropped}
    return [classes[index] for index in sorted(classes)]


def _examples(held_out: list[HeldOut]) -> list[HeldOutExample]:
    if not held_out:
        return []
    count = min(MAX_EXAMPLES, len(held_out))
    chosen = np.linspace(0, len(held_out) - 1, count).round().astype(int)
    return [
        HeldOutExample(
            f"frame {held_out[i].frame_index}",
            held_out[i].real,
            held_out[i].rendered,
            held_out[i].restored,
            held_out[i].psnr,
            held_out[i].ssim,
            held_out[i].confidence,
        )
        for i in chosen
    ]


def medium_curves(water: WaterSummary | None, unit: str) -> MediumCurves | None:
    """The water, in ``unit``, as the report draws it."""
    if water is None:
        return None
    return MediumCurves(
        beta=_rgb(water.beta_a),
        b=_rgb(water.b),
        B_inf=_rgb(water.B_inf),
        B_res=_rgb(water.B_res),
        d=_rgb(water.d),
        range_p5=water.range_p5,
        range_p95=water.range_p95,
        unit=unit,
    )


def _rgb(values: list[float]) -> tuple[float, float, float]:
    red, green, blue = values
    return red, green, blue
