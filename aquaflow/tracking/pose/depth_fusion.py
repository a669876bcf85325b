"""Fusing two-view depths into a keyframe's pointmap, and handing the map to the next keyframe."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.geometry.two_view import (
    MAX_REPROJECTION_PX,
    MAX_RHO,
    MIN_CROSS_SQ,
    MIN_DEPTH,
    MIN_PARALLAX_RAD,
    MIN_RHO,
    triangulate,
)
from aquaflow.keyframes import UNKNOWN_VARIANCE, Pointmap
from aquaflow.prior.contract import PairGeometry
from aquaflow.render.library import Library, library_or_none

Array = npt.NDArray[np.float64]

LEAST_CONFIDENCE = 0.005
"""Confidence that a match is given at least. Next to a depth edge it falls below a hundredth: taken
for 0.05 there, forward views drifted by 0.3 to 0.5 % more per 100 keyframes
(notes/2026-11-tracking.md#forward-views)."""
MEASUREMENT_FLOOR = 0.01
"""Relative sigma that no single two-view depth is trusted beyond: flow errors are not independent
from frame to frame."""
FUSED_FLOOR = 0.003
"""Relative sigma that no fused depth is trusted beyond (same reason)."""
MOST_FUSED = 300
"""Frames after which a pointmap is as good as it gets, half a minute at 10 a second. A frame's pose
takes its scale from the pointmap and hands its errors back with its depths, so that endless fusion
may drift: where tracking had diverged, after 65,000 frames at one place, a keyframe's depths were
22 % from what they had been, while its links to others were not."""
GATE_SIGMAS = 3.0
"""A measurement further off than this disagrees: it does not move the depth, it lowers trust."""
DISAGREEMENT_INFLATION = 1.3
"""Growth of the variance of a depth that a measurement disagrees with: about five in a row double
its sigma."""
TRANSFER_INFLATION = 1.5
"""Variance growth when a pointmap moves to another keyframe through matches."""
MIN_KNOWN_NEIGHBOURS = 0.25
"""Bilinear weight of the known pixels from which a depth between pixels is known too."""
FORGETTING_VARIANCE_SIGMAS = 0.5
"""A depth whose relative sigma grew past this by disagreement is replaced by the new
measurement."""


_CONSTANTS = {
    "min_rho": MIN_RHO,
    "max_rho": MAX_RHO,
    "min_depth": MIN_DEPTH,
    "max_reprojection_px": MAX_REPROJECTION_PX,
    "min_cross_sq": MIN_CROSS_SQ,
    "min_sine": float(np.sin(MIN_PARALLAX_RAD)),
    "unknown_variance": UNKNOWN_VARIANCE,
    "least_confidence": LEAST_CONFIDENCE,
    "measurement_floor": MEASUREMENT_FLOOR,
    "fused_floor": FUSED_FLOOR,
    "gate_sigmas": GATE_SIGMAS,
    "disagreement_inflation": DISAGREEMENT_INFLATION,
    "forgetting_sigmas": FORGETTING_VARIANCE_SIGMAS,
}
"""In the order of ``FuseDepths`` of native/fuse_depths.h."""


class _NativeFusion(ctypes.Structure):
    """``FuseDepths`` of native/fuse_depths.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("matches", "valid", "confidence")),
        *((name, ctypes.c_void_p) for name in ("rho", "variance")),
        *((name, ctypes.c_int32) for name in ("width", "height")),
        *((f"{name}_a", ctypes.c_double) for name in ("fx", "fy", "cx", "cy")),
        *((f"{name}_b", ctypes.c_double) for name in ("fx", "fy", "cx", "cy")),
        ("R", ctypes.c_double * 9),
        ("t", ctypes.c_double * 3),
        ("sigma_px", ctypes.c_double),
        *((name, ctypes.c_double) for name in _CONSTANTS),
    )


def fuse(
    pointmap: Pointmap,
    pair: PairGeometry,
    T_ba: Sim3,
    camera_b: CameraModel,
    sigma_px: float,
) -> float:
    """Inverse-variance fusion of the pair's triangulated depths into ``pointmap`` (in place).

    Returns the share of the picture that got a usable measurement; 0 for a pointmap that has had
    enough of them.

    Raises:
        ValueError: the pair is not of the pointmap's size.
    """
    if pointmap.fused >= MOST_FUSED:
        return 0.0
    pointmap.fused += 1
    library = library_or_none()
    if library is None:
        measured = fuse_by_numpy(pointmap, pair, T_ba, camera_b, sigma_px)
    else:
        measured = fuse_compiled(library, pointmap, pair, T_ba, camera_b, sigma_px)
    return measured / pointmap.camera.width / pointmap.camera.height


def fuse_by_numpy(
    pointmap: Pointmap,
    pair: PairGeometry,
    T_ba: Sim3,
    camera_b: CameraModel,
    sigma_px: float,
) -> int:
    """As :func:`fuse`, readable; returns how many pixels got a usable measurement."""
    rows, columns = np.nonzero(pair.valid)
    if len(rows) == 0:
        return 0
    camera = pointmap.camera
    rays = camera.unproject(np.stack([columns + 0.5, rows + 0.5], -1))
    matched = pair.matches[rows, columns].astype(np.float64)
    old_rho, old_variance = pointmap.rho[rows, columns], pointmap.variance[rows, columns]
    fresh = (old_variance >= UNKNOWN_VARIANCE) | (
        old_variance > (FORGETTING_VARIANCE_SIGMAS * old_rho) ** 2
    )
    expected = np.where(fresh, 0.0, old_rho)
    new = triangulate(rays, matched, T_ba, camera_b, sigma_px, expected)
    confidence = np.maximum(pair.C[rows, columns].astype(np.float64), LEAST_CONFIDENCE)
    floor = MEASUREMENT_FLOOR * np.where(fresh, new.rho, old_rho)
    variance = np.maximum(new.variance / confidence, floor**2)

    distance = np.abs(new.rho - old_rho)
    agrees = fresh | (distance < GATE_SIGMAS * np.sqrt(variance + old_variance))
    merged_variance = variance * old_variance / (variance + old_variance)
    merged = (new.rho * old_variance + old_rho * variance) / (variance + old_variance)
    merged = np.where(fresh, new.rho, merged)
    merged_variance = np.where(fresh, variance, merged_variance)
    merged_variance = np.maximum(merged_variance, (FUSED_FLOOR * merged) ** 2)

    sound = new.good & np.isfinite(merged) & np.isfinite(merged_variance)
    use = sound & agrees
    distrust = sound & ~agrees
    pointmap.rho[rows, columns] = np.where(use, merged, old_rho)
    kept = np.where(distrust, old_variance * DISAGREEMENT_INFLATION, old_variance)
    pointmap.variance[rows, columns] = np.where(use, merged_variance, kept)
    return int(new.good.sum())


def fuse_compiled(
    library: Library,
    pointmap: Pointmap,
    pair: PairGeometry,
    T_ba: Sim3,
    camera_b: CameraModel,
    sigma_px: float,
) -> int:
    """As :func:`fuse_by_numpy`, in a tenth of the time (native/fuse_depths.h)."""
    camera, shape = pointmap.camera, pointmap.rho.shape
    pointmap.rho = np.ascontiguousarray(pointmap.rho, np.float64)
    pointmap.variance = np.ascontiguousarray(pointmap.variance, np.float64)
    in_order: dict[str, npt.NDArray[Any]] = {
        "matches": np.ascontiguousarray(pair.matches, np.float32),
        "valid": np.ascontiguousarray(pair.valid, np.bool_),
        "confidence": np.ascontiguousarray(pair.C, np.float32),
        "rho": pointmap.rho,
        "variance": pointmap.variance,
    }
    for name, array in in_order.items():
        if array.shape[:2] != shape:
            raise ValueError(f"{name} is {array.shape}, and the pointmap {shape}")
    given = _NativeFusion(**{name: array.ctypes.data for name, array in in_order.items()})
    given.height, given.width = shape
    for of, each in (("a", camera), ("b", camera_b)):
        for name in ("fx", "fy", "cx", "cy"):
            setattr(given, f"{name}_{of}", getattr(each, name))
    given.R[:], given.t[:] = T_ba.R.reshape(-1), T_ba.in_source_unit().t
    given.sigma_px = sigma_px
    for name, constant in _CONSTANTS.items():
        setattr(given, name, constant)
    return library.call("aq_fuse_depths", ctypes.byref(given))


def transfer(
    pointmap: Pointmap,
    source_pixels: npt.NDArray[np.float32],  # [H, W, 2] px, where each pixel of b lies in a
    reliable: npt.NDArray[np.bool_],  # [H, W] pixels of b whose source is valid
    T_ba: Sim3,
    camera_b: CameraModel,
) -> Pointmap:
    """The pointmap seen from b: every reliable pixel of b takes the depth of its match in a."""
    source = source_pixels[reliable].astype(np.float64)
    rho_a, variance_a = _interpolate(pointmap, source)
    known = rho_a > 1e-6
    rays = pointmap.camera.unproject(source)
    depth_b = T_ba.apply(rays / np.where(known, rho_a, 1.0)[:, None])[:, 2]
    seen = known & (depth_b > 1e-3)
    rho_b = np.where(seen, 1.0 / np.maximum(depth_b, 1e-3), 0.0)
    # d rho_b / d rho_a = (rho_b / rho_a)^2 to first order, along rays that are nearly parallel.
    gain = (rho_b / np.where(known, rho_a, 1.0)) ** 4
    moved = Pointmap.unknown(camera_b)
    moved.rho[reliable] = rho_b
    moved.variance[reliable] = np.where(seen, variance_a * gain, UNKNOWN_VARIANCE)
    return moved


def _interpolate(
    pointmap: Pointmap,
    pixels: Array,  # [M, 2] px
) -> tuple[Array, Array]:
    """Inverse depth [M] between the four pixels around, and its variance; 0 where unknown.

    On a plane the inverse depth is linear in the picture: the mean is exact there, where the
    nearest pixel's depth is half a pixel's slope off. Across a depth edge neither is right, and
    the spread of the four says by how much.
    """
    height, width = pointmap.rho.shape
    at = np.clip(pixels - 0.5, 0.0, (width - 1.0, height - 1.0))
    column = np.minimum(at[:, 0].astype(np.intp), max(width - 2, 0))
    row = np.minimum(at[:, 1].astype(np.intp), max(height - 2, 0))
    right, below = at[:, 0] - column, at[:, 1] - row
    weights = np.stack(
        [(1 - right) * (1 - below), right * (1 - below), (1 - right) * below, right * below]
    )
    rows, columns = np.stack([row, row, row + 1, row + 1]), np.stack([column, column + 1] * 2)
    rho, variance = pointmap.rho[rows, columns], pointmap.variance[rows, columns]
    weights = np.where((rho > 1e-6) & (variance < UNKNOWN_VARIANCE), weights, 0.0)
    total = weights.sum(0)
    known = total >= MIN_KNOWN_NEIGHBOURS
    weights /= np.where(known, total, 1.0)
    mean = (weights * rho).sum(0)
    spread = (weights * (rho - mean) ** 2).sum(0)
    return (
        np.where(known, mean, 0.0),
        TRANSFER_INFLATION * (weights * variance).sum(0) + spread,
    )
