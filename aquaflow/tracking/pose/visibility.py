"""What a frame should show of a keyframe, and how much of that was matched.

Matches are lost for two reasons. Where the view has moved on, a new keyframe brings them back;
where something hides the scene (marine snow, silt, fish, a flash) it does not, and a keyframe that
shows flakes is worse than the clear one. The pose separates the two cases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MAX_TURN = np.cos(np.radians(30.0))
"""Cosine of the angle between two rays to a point beyond which it need not look the same. Survey
pictures 20 degrees apart still match 98 % of what both show."""
MAX_ZOOM = 1.5
"""Ratio of two ranges of a point beyond which it need not look the same."""
POINTS = 4000
"""Points sampled: a share of 1 % is known to better than a tenth of it."""
AGREEMENT_WIDTHS = 3.0 / 480.0
"""Distance between a match and where the pose puts it, over width, up to which they agree; six
sigmas of a checked DIS match at 480 px."""


@dataclass(frozen=True)
class Visibility:
    """A keyframe's points in a frame."""

    overlap: float
    """Share of the keyframe's known points that the frame should show, by the pose alone."""
    seen: float
    """Of these, the share that was matched, and to where the pose puts it: what is missing is
    hidden. Large flakes remove matches, small ones displace them."""


def is_expected(
    points: Array,  # [M, 3] in the keyframe
    T_fk: Sim3,
    camera: CameraModel,
) -> Mask:
    """[M] points that a frame at ``T_fk`` shows as the keyframe does: in the picture, at a similar
    angle and range."""
    Y = T_fk.apply(points)
    pixels = camera.project(Y)
    inside = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(-1)
    # Y / scale: both ranges in the keyframe's unit.
    turned = points @ T_fk.R.T
    range_k, range_f = np.linalg.norm(turned, axis=1), np.linalg.norm(Y, axis=1)
    alike = (turned * Y).sum(1) > MAX_TURN * range_k * range_f
    zoom = range_f / np.maximum(T_fk.scale * range_k, 1e-12)
    alike &= (zoom < MAX_ZOOM) & (zoom > 1.0 / MAX_ZOOM)
    return np.asarray(inside & alike & (Y[:, 2] > 0.0))


def visibility(
    pointmap: Pointmap,
    looked_at: Mask,  # [H, W] pixels of the keyframe that a match is expected of
    matches: npt.NDArray[np.float32],  # [H, W, 2] px
    valid: Mask,  # [H, W] those that were matched
    T_fk: Sim3,
    camera: CameraModel,
) -> Visibility:
    """Of the points of ``pointmap`` at ``looked_at`` pixels, all of known depth.

    Where the frame should show none of them, none of them is missing.
    """
    rows, columns, points = sample(pointmap, looked_at, POINTS)
    here = is_expected(points, T_fk, camera)
    if not here.any():
        return Visibility(0.0, 1.0)
    rows, columns, points = rows[here], columns[here], points[here]
    off = np.linalg.norm(camera.project(T_fk.apply(points)) - matches[rows, columns], axis=1)
    seen = valid[rows, columns] & (off < AGREEMENT_WIDTHS * camera.width)
    return Visibility(float(here.mean()), float(seen.mean()))


def evenly_taken(
    which: Mask,  # [H, W]
    count: int,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns, [M] each, of at most ``count`` of the pixels, evenly taken row by row."""
    # Of a picture in two dimensions NumPy looks for them ten times as long.
    pixels = np.flatnonzero(which)
    pixels = pixels[:: max(1, -(-len(pixels) // count))]
    rows, columns = np.divmod(pixels, which.shape[1])
    return rows, columns


def sample(
    pointmap: Pointmap,
    which: Mask,  # [H, W] pixels of known depth
    count: int,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], Array]:
    """Rows, columns and points [M, 3] of at most ``count`` pixels, evenly taken."""
    rows, columns = evenly_taken(which, count)
    rays = pointmap.camera.unproject(np.stack([columns + 0.5, rows + 0.5], -1))
    return rows, columns, rays / pointmap.rho[rows, columns, None]


def predicted_matches(
    pointmap: Pointmap,
    known: Mask,  # [H, W] pixels whose depth is valid
    T_fk: Sim3,
    camera: CameraModel,
    otherwise: npt.NDArray[np.float32],  # [H, W, 2] px
) -> npt.NDArray[np.float32]:
    """[H, W, 2] px where the pose puts the keyframe's pixels; ``otherwise`` where it cannot."""
    rows, columns, points = sample(pointmap, known, known.size)
    out = otherwise.copy()
    out[rows, columns] = camera.project(T_fk.apply(points))
    return out


def agreeing(
    pointmap: Pointmap,
    matches_back: npt.NDArray[np.float32],  # [H, W, 2] px, where each pixel of the frame lies
    valid_back: Mask,  # [H, W]
    T_fk: Sim3,
    camera: CameraModel,
) -> Mask:
    """[H, W] pixels of the frame that show the point that their match in the keyframe is."""
    rows, columns = np.nonzero(valid_back)
    source = matches_back[rows, columns].astype(np.float64)
    height, width = pointmap.rho.shape
    u = np.clip(np.floor(source[:, 0]).astype(np.intp), 0, width - 1)
    v = np.clip(np.floor(source[:, 1]).astype(np.intp), 0, height - 1)
    rho = pointmap.rho[v, u]
    rays = pointmap.camera.unproject(source)
    pixels = camera.project(T_fk.apply(rays / np.maximum(rho, 1e-12)[:, None]))
    off = np.linalg.norm(pixels - np.stack([columns + 0.5, rows + 0.5], -1), axis=1)
    good = (rho > 1e-6) & (off < AGREEMENT_WIDTHS * camera.width)
    out = np.zeros_like(valid_back)
    out[rows[good], columns[good]] = True
    return out
