"""What a keyframe shows, in few numbers: the mean depth of each block of its picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.keyframes.place import Pointmap

Array = npt.NDArray[np.float64]

BLOCKS = (18, 24)
"""Rows and columns of the blocks: 864 bytes a keyframe, 31 MB for ten hours with one a second."""
LARGEST_SIGMA = 0.25
"""Relative 1 sigma of an inverse depth up to which a pixel counts as placed: judgement; at 0.25 a
block of a hundred such pixels lies within one cell of its place."""
LEAST_KNOWN = 1.0 / 16.0
"""Share of a block's pixels that must be placed: three of a block of 8 x 6."""
STEP = 1.5
"""Ratio of depths between a block and its corners from which an edge runs through it, and what lies
between was not seen."""


@dataclass(frozen=True)
class Footprint:
    """Depths of the blocks of a picture."""

    camera: CameraModel
    """Of the pointmap."""
    z: npt.NDArray[np.float16]
    """[18, 24] mean depth along the camera's axis, in the keyframe's unit; 0 where unknown."""

    @staticmethod
    def of(pointmap: Pointmap) -> Footprint:
        """The footprint of a pointmap, with what a prior knows where nothing was triangulated."""
        whole = pointmap.complete(LARGEST_SIGMA)
        known = whole.is_known(LARGEST_SIGMA)
        return Footprint(whole.camera, _depths(np.where(known, whole.rho, 0.0)))

    @property
    def known(self) -> bool:
        """True if it shows anything."""
        return bool((self.z > 0.0).any())

    @cached_property
    def depth(self) -> float:
        """Median depth, in the keyframe's unit; 0 where nothing is known."""
        z = self.z[self.z > 0.0]
        return float(np.median(z)) if len(z) else 0.0

    def patches(self) -> tuple[Array, Array]:
        """Corners [P, 4, 3] of the blocks whose depth is known, camera frame, in the keyframe's
        unit: top left, top right, bottom left, bottom right; and the blocks' depths [P]."""
        rows, columns = BLOCKS
        z = self.z.astype(np.float64)
        known = z > 0.0
        rho = np.divide(1.0, z, out=np.zeros_like(z), where=known)
        sums, counts = np.zeros((rows + 1, columns + 1)), np.zeros((rows + 1, columns + 1))
        for i, j in CORNERS:
            sums[i : i + rows, j : j + columns] += rho
            counts[i : i + rows, j : j + columns] += known
        depth = np.divide(counts, sums, out=np.zeros_like(sums), where=sums > 0.0)
        corners = corner_rays(self.camera) * depth[..., None]
        parts = [(depth[i : i + rows, j : j + columns], i, j) for i, j in CORNERS]
        smooth = known.copy()
        for part, _, _ in parts:
            smooth &= (part < STEP * z) & (z < STEP * part)
        patches = [corners[i : i + rows, j : j + columns][smooth] for _, i, j in parts]
        return np.stack(patches, axis=1), z[smooth]


CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Row and column of a block's corners, from its own."""


def _depths(
    rho: Array,  # [H, W] inverse depths, 0 where unknown
) -> npt.NDArray[np.float16]:
    """[18, 24] one over the mean inverse depth of each block; 0 where too little is known."""
    sums, counts, sizes = (_of_blocks(each) for each in (rho, rho > 0.0, np.ones_like(rho)))
    enough = counts >= np.maximum(1.0, LEAST_KNOWN * sizes)
    z = np.divide(counts, sums, out=np.zeros_like(sums), where=enough)
    half = np.finfo(np.float16)
    z[(z < float(half.tiny)) | (z > float(half.max))] = 0.0
    return z.astype(np.float16)


def _of_blocks(
    values: npt.NDArray[np.generic],  # [H, W]
) -> Array:
    """[18, 24] sums over the blocks."""
    rows, columns = (
        (np.arange(count) * side) // count for count, side in zip(BLOCKS, values.shape, strict=True)
    )
    by_row = np.add.reduceat(values, rows, axis=0, dtype=np.float64)
    return np.asarray(np.add.reduceat(by_row, columns, axis=1))


@lru_cache(maxsize=8)
def corner_rays(camera: CameraModel) -> Array:
    """[19, 25, 3] points at z = 1 on the rays of the blocks' corners."""
    rows, columns = BLOCKS
    v = (np.arange(rows + 1) * camera.height) // rows
    u = (np.arange(columns + 1) * camera.width) // columns
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1).astype(np.float64))
    rays.setflags(write=False)
    return rays


# --------------------------------------------------------------------------------------------------
# How far a camera can map through a water, and how far an eye would see.
#
# The apparent contrast of what lies at the range z is ``C(z) = C(0) exp(-c z)`` along a path on
# which the water's own light is as bright as the scene (S. Q. Duntley, Light in the sea, J. Opt.
# Soc. Am. 53, 214, 1963, Eq. 8; the same law as H. Koschmieder's of 1924 for fog). ``c`` is the
# fitted attenuation of the direct light, of the channel that reaches furthest.

TEXTURE_CONTRAST = 0.6
"""Of the ground's own texture, deviation over mean: as the white balance takes it
(water/white_balance.py)."""
VISIBLE_CONTRAST = 0.05
"""Share of its contrast with which a thing is still seen: the threshold of the meteorological
optical range (WMO-No. 8, Guide to Instruments and Methods of Observation, chapter 9). A black disc
in water is seen to 1 % (Davies-Colley, Limnol. Oceanogr. 33, 1988), half as far again."""


def mapping_range(attenuation: Sequence[float], least_contrast: float) -> float | None:
    """The range beyond which the texture's apparent contrast is below ``least_contrast``, in the
    unit whose inverse ``attenuation`` (of each channel) has; None where no water is to be seen."""
    return _range(attenuation, TEXTURE_CONTRAST, least_contrast)


def visibility(attenuation: Sequence[float]) -> float | None:
    """The range at which contrasts fall to VISIBLE_CONTRAST; in the same unit."""
    return _range(attenuation, 1.0, VISIBLE_CONTRAST)


def _range(attenuation: Sequence[float], inherent: float, apparent: float) -> float | None:
    least = min((float(value) for value in attenuation), default=0.0)
    if not np.isfinite(least) or least <= 0.0:
        return None
    return float(np.log(inherent / apparent)) / least
