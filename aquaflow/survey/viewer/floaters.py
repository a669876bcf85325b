"""Gaussians of which no camera saw more than a sliver, and that cover much from elsewhere.

A map is optimised to look right from the dive's cameras. What a Gaussian does where none of them
looks costs nothing there: at the map's edge it reaches out of every picture, along a ray it may be
a needle that is seen end on, behind a surface it may be of any size. From a free view these are
spikes and clouds. So the test is what the cameras were shown: the area that a Gaussian has in a
picture, by its weight in the colour of each pixel (alpha times transmittance; B. Kerbl et al., 3D
Gaussian Splatting, 2023), against the area that it would have where it is seen broadside and alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from aquaflow.dive.ply import PlyGaussians
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3

Mask = npt.NDArray[np.bool_]
Float = npt.NDArray[np.float64]

LEAST_SHOWN = 0.03
"""Share of its area broadside that some picture shows of what is on a surface; of true surface even
at 2 degrees to it. Hiding the rest costs held-out views 0.00 to 0.02 dB
(notes/2026-11-survey.md#floaters)."""
LEAST_SIZE = 0.01
"""Longest standard deviation over the range to the nearest camera: what is smaller is no spike."""
MOST_CAMERAS = 64
"""From which the map is drawn: as many of the path, evenly spread."""
AS_NEAR = 1.25
"""By how much the nearest of those may be farther than the nearest camera of all: what they did not
come close to is not judged."""
MOST_WIDTH = 480
"""Pixels of a drawn picture."""


def find_floaters(gaussians: PlyGaussians, poses: Sequence[Sim3], camera: CameraModel) -> Mask:
    """[N] True for what floats, of Gaussians that the cameras at ``poses`` (camera to their world)
    saw; False throughout where the compiled renderer is not to be had."""
    from aquaflow.render.library import library_or_none

    none = np.zeros(len(gaussians.means), bool)
    sound: Mask = np.isfinite(np.hstack([gaussians.means, gaussians.scales])).all(axis=1)
    if not sound.any() or not poses or library_or_none() is None:
        return none
    step = -(-len(poses) // MOST_CAMERAS)
    ranges, judged = (_ranges(gaussians.means[sound], each) for each in (poses, poses[::step]))
    axes = -np.sort(-gaussians.scales[sound].astype(np.float64), axis=1)
    large = (axes[:, 0] > LEAST_SIZE * ranges) & (judged <= AS_NEAR * ranges)
    if not large.any():
        return none
    broadside = 2.0 * np.pi * gaussians.opacities[sound] * axes[:, 0] * axes[:, 1] / ranges**2
    shown = _largest_areas(gaussians.rows(sound), poses[::step], camera, float(np.median(ranges)))
    none[np.flatnonzero(sound)] = large & (shown < LEAST_SHOWN * broadside)
    return none


def _ranges(
    means: npt.NDArray[np.floating],  # [N, 3]
    poses: Sequence[Sim3],
) -> Float:
    """[N] to the nearest camera."""
    found = cKDTree(np.array([pose.t for pose in poses])).query(means)[0]
    return np.maximum(np.asarray(found, np.float64), 1e-12)


def _largest_areas(
    gaussians: PlyGaussians, poses: Sequence[Sim3], camera: CameraModel, unit: float
) -> npt.NDArray[np.float32]:
    """[N] largest area in a picture, over the focal length squared: by the gradient of a picture's
    sum with respect to colours, which is what each weighs in it. ``unit``: a usual range, by which
    lengths are divided; the renderer's nearest range is for metres."""
    import torch

    from aquaflow.render import select_renderer

    renderer = select_renderer("cpu")
    shrunk = min(1.0, MOST_WIDTH / camera.width)
    small = camera.resize(round(shrunk * camera.width), max(1, round(shrunk * camera.height)))
    K = torch.tensor(small.K, dtype=torch.float32)
    parts = (gaussians.means / unit, gaussians.wxyz, gaussians.scales / unit, gaussians.opacities)
    means, quats, scales, opacities = (
        torch.from_numpy(np.array(part, np.float32)) for part in parts
    )
    largest = np.zeros(len(gaussians.means), np.float32)
    for pose in poses:
        colours = torch.ones(len(largest), 3, requires_grad=True)
        viewmat = torch.eye(4)
        viewmat[:3, :3] = torch.from_numpy(pose.R.T.astype(np.float32))
        viewmat[:3, 3] = torch.from_numpy((-pose.R.T @ pose.t / unit).astype(np.float32))
        drawn = renderer(
            means, quats, scales, opacities, colours, viewmat, K, small.width, small.height
        )
        if drawn.image.requires_grad:
            (weights,) = torch.autograd.grad(drawn.image[..., 0].sum(), colours)
            np.maximum(largest, weights[:, 0].numpy(), out=largest)
    return largest / np.float32(small.fx * small.fy)
