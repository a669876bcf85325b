"""A cross-section of the map: what lies in an upright slice between two points, seen square on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.survey.viewer.measuring import (
    Array,
    Asked,
    MeasuringScene,
    is_finite,
    ray_of,
    vector,
)
from aquaflow.survey.viewer.splats import ViewerSplats, covariances

MOST_DRAWN = 20_000
"""Gaussians of a slice that a browser draws, those that cover most: 1 MB."""
LEAST_OPACITY = 0.1
"""Fainter ones are no surface."""
SHOWN_HEIGHTS = (0.5, 99.5)
"""Percentiles of the heights that are drawn, and half as much to either side: one far off would
make the others a line."""
MOST_ALONG = 0.999
"""Cosine between the line and up, or the eye's direction, to which a slice has a plane."""


def section(asked: Sequence[Asked], thickness: object, scene: MeasuringScene) -> Asked:
    """What a browser draws of the slice from the first point to the last, ``thickness`` thick in
    the unit of lengths: upright where there is a vertical, else along the ray of the first point.

    For each Gaussian ``along`` (from the first point), ``height`` (above it), ``depth`` behind the
    slice's middle, its covariance ``xx``, ``xy``, ``yy`` in that plane, ``rgb`` (0 to 255) and
    ``alpha``; all lengths in ``unit``. The farthest come first.

    Raises:
        InputError: the points or the thickness are none, or nothing lies there.
    """
    if not is_finite(thickness) or not isinstance(thickness, (int, float)) or thickness <= 0.0:
        raise InputError("the thickness of a cross-section is a positive length; give another one")
    metres = scene.frame.metres
    ends = np.array([vector(point.get("place"), "a point") for point in (asked[0], asked[-1])])
    axes, length = _axes(ends, asked[0], scene)
    splats = scene.splats
    inside = (splats.centres - ends[0].astype(np.float32)) @ axes.T.astype(np.float32)
    slice_ = np.abs(inside[:, 2]) <= 0.5 * thickness / metres
    slice_ &= (inside[:, 0] >= 0.0) & (inside[:, 0] <= length) & (splats.opacities > LEAST_OPACITY)
    chosen = np.flatnonzero(slice_)[:MOST_DRAWN]
    if not len(chosen):
        raise InputError("nothing is mapped in this slice; make it thicker, or mark other points")
    low, high = np.percentile(inside[chosen, 1], SHOWN_HEIGHTS)
    margin = 0.5 * (high - low) + 0.02 * length
    near = np.abs(inside[chosen, 1] - 0.5 * (low + high)) <= 0.5 * (high - low) + margin
    chosen = chosen[near]
    chosen = chosen[np.argsort(-inside[chosen, 2], kind="stable")]
    places = metres * inside[chosen]
    return _drawn(splats, chosen, places, axes, metres) | {
        "length": metres * length, "low": float(places[:, 1].min()),
        "high": float(places[:, 1].max()), "thickness": float(thickness),
        "unit": scene.frame.scale.unit, "upright": scene.frame.has_vertical,
    }  # fmt: skip


def _axes(
    ends: Array,  # [2, 3]
    first: Asked,
    scene: MeasuringScene,
) -> tuple[Array, float]:
    """Rows [3, 3]: along the line, up, and to behind the slice; and the line's length."""
    up = scene.up if scene.frame.has_vertical else -ray_of(first)[1]
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    line = ends[1] - ends[0]
    if abs(line @ up) >= MOST_ALONG * float(np.linalg.norm(line)):
        raise InputError("a cross-section's ends lie above each other; mark them farther apart")
    if scene.frame.has_vertical:
        line = line - (line @ up) * up
    length = float(np.linalg.norm(line))
    along = line / length
    across = up - (up @ along) * along
    across /= np.linalg.norm(across)
    # Along, up and towards who looks are right-handed.
    return np.stack([along, across, -np.cross(along, across)]), length


def _drawn(
    splats: ViewerSplats,
    chosen: npt.NDArray[np.intp],  # [M]
    places: Array,  # [M, 3]
    axes: Array,  # [3, 3]
    metres: float,
) -> Asked:
    J = metres * axes[:2].astype(np.float32)
    C = J @ covariances(splats.wxyz[chosen], splats.scales[chosen]) @ J.T
    columns = {
        "along": places[:, 0], "height": places[:, 1], "depth": places[:, 2], "xx": C[:, 0, 0],
        "xy": C[:, 0, 1], "yy": C[:, 1, 1], "alpha": splats.opacities[chosen],
    }  # fmt: skip
    said: Asked = {name: [float(f"{v:.4g}") for v in values] for name, values in columns.items()}
    rgb = np.rint(255.0 * np.clip(splats.colours[chosen], 0.0, 1.0)).astype(int)
    return said | {"rgb": rgb.tolist()}
