"""The report's lengths and directions in words, each with 1 sigma where it is known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.survey.report import Measures, MediumCurves, PathPlot
from aquaflow.telemetry.metric_frame import MetricFrame


def measures(path: PathPlot, frame: MetricFrame, water: MediumCurves | None) -> Measures:
    """Of the path in n, the largest sub-map's ``frame``, and the water in its unit."""
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


def _unit(frame: MetricFrame) -> str:
    if not frame.metric:
        return "map units"
    return f"metres, \u00b1 {100.0 * frame.scale_sigma:.2g} %"


def _gravity(frame: MetricFrame) -> str:
    if not frame.level:
        return "unknown: the world is turned as the first keyframe's camera"
    return f"z points down, \u00b1 {np.degrees(frame.tilt_sigma_rad):.2g} degrees"


def _north(frame: MetricFrame) -> str:
    if not frame.level:
        return "to the right in the first keyframe"
    if frame.north in {"true north", "magnetic north"}:
        return f"to {frame.north}, \u00b1 {np.degrees(frame.heading_sigma_rad):.2g} degrees"
    return f"to {frame.north}; where north is, is unknown"


def _place(frame: MetricFrame) -> list[tuple[str, str]]:
    origin = frame.origin
    if origin is None:
        return []
    where = f"{origin.latitude_deg:.6f}, {origin.longitude_deg:.6f} (WGS 84)"
    return [("origin", f"{where} \u00b1 {origin.sigma_m:.2g} m, from {origin.source}")]


def _lengths(path: PathPlot, frame: MetricFrame) -> list[tuple[str, str]]:
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
    frame: MetricFrame,
) -> tuple[str, str]:
    if frame.metric and frame.depth_known:
        sigma = float(np.sqrt(frame.position_covariance(np.array([0.0, 0.0, z.mean()]))[2, 2]))
        return "depth of the camera", f"{z.min():.2f} to {z.max():.2f} m, \u00b1 {sigma:.2g} m"
    return "height difference", _length(float(np.ptp(z)), frame)


def _length(value: float, frame: MetricFrame) -> str:
    """With the digits that its sigma leaves."""
    if not frame.metric:
        return f"{value:.4g} {frame.unit}"
    sigma = value * frame.scale_sigma
    decimals = min(max(1 - int(np.floor(np.log10(max(sigma, 1e-3)))), 0), 3)
    return f"{value:.{decimals}f} \u00b1 {sigma:.{decimals}f} m"
