"""The values of report.html: of a dive that goes on, that ends, or that ended long ago."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.dive.dive import Dive
from aquaflow.dive.frames_csv import FrameRow
from aquaflow.dive.medium import NAME as MEDIUM
from aquaflow.dive.medium import Rgb, lamp_of
from aquaflow.dive.trajectory_csv import PoseRow
from aquaflow.survey.coverage.coverage_file import NAME as COVERAGE
from aquaflow.survey.coverage.coverage_file import read_coverage_file
from aquaflow.survey.coverage.page_view import PageView
from aquaflow.survey.export.ortho.ground import ACROSS_GROUND, ALONG_GRAVITY, OVERVIEW
from aquaflow.survey.measure.quantity import Quantity
from aquaflow.survey.measure.reef_numbers import JSON as REEF
from aquaflow.survey.report.data import (
    CameraSummary,
    DepthProfile,
    HeldOutExample,
    LeftOut,
    Measures,
    MediumCurves,
    PathPlot,
    ReefRow,
    ReportData,
)
from aquaflow.telemetry.world_frame import WorldFrame

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
        fixes=dive.fixes,
        reef=[] if dive.is_going_on else _reef(dive),
        timeline=[row.frame_class for row in rows],
        examples=_examples(dive),
        medium=medium,
        coverage=_coverage(dive),
        overview=None if dive.is_going_on else _overview(dive),
        vertical=ALONG_GRAVITY if frame.level else ACROSS_GROUND,
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
    ahead = {each.ahead for each in own}
    return PathPlot(
        np.array([(row.x, row.y, row.z) for row in rows]).reshape(-1, 3),
        [classes.get(row.index, "common") for row in rows],
        [row.sub_map for row in rows],
        unit=frame.unit,
        up=frame.ahead if len(ahead) == 1 else "",
        depth_known=frame.depth_known,
        placed=level and all(each.metric for each in own),
    )


def _medium(dive: Dive) -> MediumCurves | None:
    content = dive.medium_facts
    if not content.get("active"):
        return None
    try:
        scattered = content["backscatter"]
        beta = _rgb(content["attenuation_per_unit"])
        b, B_inf, B_res, d = (_rgb(scattered[name]) for name in ("b", "B_inf", "B_res", "d"))
        span = float(content["range_p5"]), float(content["range_p95"])
        white = _white(content.get("restored"))
        light = content.get("lightness_over_range")
        lamp = lamp_of(content)
        lightness = None if light is None else (float(light["seen"]), float(light["restored"]))
        sigma = content.get("attenuation_relative_sigma")
        beta_sigma = None if sigma is None else _rgb(sigma)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{dive.file(MEDIUM)} is damaged; map the dive again") from error
    return MediumCurves(
        beta, b, B_inf, B_res, d, *span,
        unit=dive.frame.unit, white=white, lightness=lightness, lamp=lamp,
        beta_sigma=beta_sigma,
    )  # fmt: skip


def _rgb(channels: Any) -> Rgb:
    red, green, blue = (float(channel) for channel in channels)
    return red, green, blue


def _white(restored: Any) -> tuple[str, Rgb, Rgb] | None:
    """Name, gain and sigma of a white balance that is not the camera's; before 2026-11-27 none
    was."""
    said = restored.get("white_balance") if isinstance(restored, dict) else None
    if not isinstance(said, dict) or said["sigma"] is None:
        return None
    return str(said["choice"]), _rgb(said["gain"]), _rgb(said["sigma"])


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
    return numbers + [ReefRow(what.replace("_", " "), "unknown", "", why) for what, why in missing]


def _reef_row(number: dict[str, Any]) -> ReefRow:
    """Raises KeyError, TypeError or ValueError for what is none."""
    value, sigma, low, high = (
        float(number[key]) for key in ("value", "sigma", "low_95", "high_95")
    )
    read = Quantity(value, sigma, low, high, str(number["unit"]))
    words = read.in_words(), read.interval_in_words()
    return ReefRow(number["label"], *words, number["meaning"])


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


# --------------------------------------------------------------------------------------------------
# The report's values of a survey: depth and altitude over time, and what was left out.

MOST_POINTS = 2000
"""Of a profile; a screen shows fewer."""
MOST_REASONS = 12
"""Lines of the table; what is rarer is one line."""
NUMBER = re.compile(r"\d+(\.\d+)?")
"""What makes one reason look like many."""


def profile(rows: Sequence[PoseRow], frame: WorldFrame) -> DepthProfile | None:
    """Depth and altitude of the dive in metres; None where neither is known.

    Without a depth sensor the depth is that of the path, where the metric frame knows the surface.
    """
    chosen = [
        rows[i] for i in np.linspace(0, len(rows) - 1, min(len(rows), MOST_POINTS)).astype(int)
    ]
    depth = np.array([np.nan if row.depth_m is None else row.depth_m for row in chosen])
    altitude = np.array([np.nan if row.altitude_m is None else row.altitude_m for row in chosen])
    said = "depth below the surface"
    if not np.isfinite(depth).any() and frame.metric and frame.level:
        depth = np.array([row.z if row.unit == "m" else np.nan for row in chosen])
        said = "depth of the camera" if frame.depth_known else "camera, down from the dive's start"
    if not (np.isfinite(depth).any() or np.isfinite(altitude).any()):
        return None
    return DepthProfile(np.array([row.t_s for row in chosen]), depth, altitude, said)


def left_out(rows: Iterable[FrameRow]) -> list[LeftOut]:
    """Frames without a pose, or of no use, by result and reason; the most frequent first."""
    counts = Counter(
        (row.frame_class, NUMBER.sub("N", row.reason.partition("\n")[0]).strip() or "not stated")
        for row in rows
        if row.frame_class in {"skipped", "lost", "dropped"}
    )
    listed = [LeftOut(kind, why, count) for (kind, why), count in counts.most_common(MOST_REASONS)]
    rest = sum(counts.values()) - sum(each.count for each in listed)
    return [*listed, LeftOut("all", "other reasons", rest)] if rest else listed


# --------------------------------------------------------------------------------------------------
# The report's lengths and directions in words, each with 1 sigma where it is known.


def measures(path: PathPlot, frame: WorldFrame, water: MediumCurves | None) -> Measures:
    """Measures of the path in n, the largest sub-map's ``frame``, and the water in its unit."""
    rows = [
        ("unit of length", _unit(frame)),
        ("scale from", frame.scale_source),
        ("gravity", _gravity(frame)),
        ("x axis", _north(frame)),
        *_place(frame),
        *_lengths(path, frame),
    ]
    if water is not None:
        seen = f"{water.range_p5:.3g} to {water.range_p95:.3g} {frame.unit}"
        rows.append(("distances seen", f"{seen} (5 % and 95 %)"))
    return Measures(rows, frame.sources)


def _unit(frame: WorldFrame) -> str:
    if not frame.metric:
        return "map units"
    return f"metres, \u00b1 {100.0 * frame.scale_sigma:.2g} %"


def _gravity(frame: WorldFrame) -> str:
    if not frame.level:
        return f"unknown: {frame.axes}"
    return f"z points down, \u00b1 {np.degrees(frame.tilt_sigma_rad):.2g} degrees"


def _north(frame: WorldFrame) -> str:
    if not frame.has_heading:
        return f"to the {frame.ahead or 'right in the first keyframe'}"
    if frame.north in {"true north", "magnetic north"}:
        return f"to {frame.north}, \u00b1 {np.degrees(frame.heading_sigma_rad):.2g} degrees"
    return f"to {frame.north}; where north is, is unknown"


def _place(frame: WorldFrame) -> list[tuple[str, str]]:
    origin = frame.origin
    if origin is None:
        return []
    where = f"{origin.latitude_deg:.6f}, {origin.longitude_deg:.6f} (WGS 84)"
    return [("origin", f"{where} \u00b1 {origin.sigma_m:.2g} m, from {origin.source}")]


def _lengths(path: PathPlot, frame: WorldFrame) -> list[tuple[str, str]]:
    """Of the largest sub-map's path alone, unless all lie in one frame."""
    positions = path.positions[np.isfinite(path.positions).all(axis=1)].reshape(-1, 3)
    if len(set(path.sub_maps)) > 1 or len(positions) < 2:
        return []
    length = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    size = np.linalg.norm(positions.max(axis=0) - positions.min(axis=0))
    rows = [
        ("length of the path", _length(length, frame)),
        ("diagonal of the box around it", _length(float(size), frame)),
    ]
    if frame.level:
        rows.append(_heights(positions[:, 2], frame))
    return rows


def _heights(
    z: npt.NDArray[np.floating],  # [N] n
    frame: WorldFrame,
) -> tuple[str, str]:
    if frame.metric and frame.depth_known:
        sigma = float(np.sqrt(frame.position_covariance(np.array([0.0, 0.0, z.mean()]))[2, 2]))
        return "depth of the camera", f"{z.min():.2f} to {z.max():.2f} m, \u00b1 {sigma:.2g} m"
    return "height difference", _length(float(np.ptp(z)), frame)


def _length(value: float, frame: WorldFrame) -> str:
    """With the digits that its sigma leaves."""
    if not frame.metric:
        return f"{value:.4g} {frame.unit}"
    sigma = value * frame.scale_sigma
    decimals = min(max(1 - int(np.floor(np.log10(max(sigma, 1e-3)))), 0), 3)
    return f"{value:.{decimals}f} \u00b1 {sigma:.{decimals}f} m"
