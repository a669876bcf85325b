"""What the calibration check found, for metrics.json and in words."""

from __future__ import annotations

from typing import Any

import numpy as np

from aquaflow.geometry.optics import virtual_centre
from aquaflow.geometry.port import FlatPort, Port
from aquaflow.tracking.calibration_check import TOLERANCE, LensError
from aquaflow.types import CameraModel

REMEDY = (
    "calibrate the camera in water, or in air with its port's measures, or leave out --calib to "
    "have the focal length estimated from the dive; until then distances and shapes are distorted"
)
"""What a user can do about a calibration that does not fit."""


def to_json(error: LensError, calibration: CameraModel) -> dict[str, Any]:
    """For metrics.json; None where the dive does not determine it. The noise of the matches is in
    px of the calibration's own pictures."""
    focal_known, radial_known = np.logical_or(error.known, error.named)
    focal, k1 = _fitting(error, calibration)
    return {
        "verdict": verdict(error),
        "focal_px": round(focal, 1) if focal_known else None,
        "focal_sigma_px": round(focal * float(error.sigma[0]), 1),
        "focal_given_px": round(calibration.fx, 1),
        "k1": round(k1, 4) if radial_known else None,
        "k1_sigma": round(float(error.sigma[1]), 4),
        "k1_given": _k1(calibration),
        "noise_px": {
            "as_given": round(error.noise_given * calibration.fx, 3),
            "focal_and_k1_fitted": round(error.noise_fitted * calibration.fx, 3),
            "further_terms_fitted": round(error.noise_further * calibration.fx, 3),
        },
        "chance": float(f"{error.chance:.1e}"),
        "keyframes": error.views,
        "matches": error.matches,
    }


def verdict(error: LensError) -> str:
    """One of ``wrong``, ``fits`` and ``cannot be told``."""
    if error.wrong:
        return "wrong"
    return "fits" if all(error.known) else "cannot be told"


def warning(error: LensError, calibration: CameraModel) -> str:
    """A sentence for a wrong calibration: the error, its certainty, the remedy."""
    focal, k1 = _fitting(error, calibration)
    focal_named, radial_named = error.named
    asked = []
    if focal_named or not radial_named:
        asked.append(
            f"a focal length of {focal:.0f} px (standard deviation "
            f"{focal * error.sigma[0]:.0f}) instead of {calibration.fx:.0f} px"
        )
    if radial_named or not focal_named:
        asked.append(
            f"a first radial distortion k1 of {k1:.3f} (standard deviation "
            f"{error.sigma[1]:.3f}) instead of {_k1(calibration):.3f}"
        )
    return (
        f"the calibration does not fit the dive: its pictures ask for {' and '.join(asked)}; a "
        f"calibration good to {100.0 * TOLERANCE[0]:.0f} % would look so by chance once in "
        f"{_times(error.chance)} dives; {REMEDY}"
    )


def port_note(calibration: CameraModel, port: Port) -> str:
    """Through which port the pictures were rectified."""
    size = (
        f"{port.distance_m:g} m before {port.thickness_m:g} m of glass"
        if isinstance(port, FlatPort)
        else f"{port.radius_m:g} m in radius, {port.thickness_m:g} m thick"
    )
    behind = -1e3 * float(virtual_centre(calibration)[2])
    where = f"{abs(behind):.1f} mm {'behind' if behind >= 0.0 else 'ahead of'} the lens"
    return (
        f"the pictures were rectified through a {port.kind} port ({size}, water of index "
        f"{port.water:.4f}), exactly at {port.range_m:g} m; the path is that of a point {where}"
    )


def _times(chance: float) -> str:
    return "more than a million" if chance < 1e-6 else f"{10 ** int(-np.log10(chance)):,}"


def _fitting(error: LensError, calibration: CameraModel) -> tuple[float, float]:
    """Focal length, px of the calibration, and k1 that fit the dive."""
    growth = float(np.exp(error.log_focal))
    return calibration.fx * growth, error.radial + _k1(calibration) * growth**2


def _k1(calibration: CameraModel) -> float:
    return calibration.distortion[0] if calibration.is_distorted else 0.0
