"""What moves by itself: fish, a diver, the vehicle's own arm (paper, Sec. 3.2: C and Q).

The network looks at shape and not at motion. From its depth and the two poses follows where the
keyframe before must have shown each pixel. What moves was elsewhere: its match, if it has one, lies
apart from that place, or gives it a false triangulated depth; and mostly it has none, because the
keyframe shows something of other colours there. A whole region of such pixels is not to be trusted
with a place in the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import UNKNOWN_VARIANCE, Pointmap
from aquaflow.optimise.robust import MAD_TO_SIGMA
from aquaflow.prior.contract import Float, Mask
from aquaflow.tracking.learned.scaling import LearnedDepth

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

COMPARED_WIDTH = 160
"""px that pictures are reduced to: the smallest region is then 8 px wide."""
DIFFERS_SIGMAS = 4.0
"""Standard errors by which depths, matches or colours differ if they are of different things
(docs/prior.md#moving has what is found and what is taken for it)."""
MATCH_SIGMA_WIDTHS = 0.003
"""Of a match, over the picture's width: across the epipolar line, where the learned depth has no
part, 95 % of those of still clips and dives lie within 0.001 to 0.003."""
LEAST_GREY = 1.0
"""Standard deviation of colours at matches that is at least assumed, of 255: rounding's."""
ALONG = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Standard errors of the learned depth at which colours are compared: one of them must fit."""
EDGE_WIDTHS = 0.012
"""Of the keyframe's border, over its width: what smoothing mixes with what is not seen."""
LEAST_WIDTHS = 0.05
"""Side of the smallest region, over the picture's width: one and a half cells of a network, whose
error is that of a whole cell."""


@dataclass(frozen=True)
class SeenBefore:
    """A picture's pixels in the keyframe before."""

    camera: CameraModel
    """Of the keyframe."""
    T: Sim3
    """From the picture to the keyframe."""
    matches: Float
    """[H, W, 2] px in the keyframe."""
    matched: Mask
    """[H, W]"""
    before: Picture | None
    """[h, w, 3] the keyframe's picture, while it is kept."""
    now: Picture
    """[H, W, 3] the picture."""


def moving(
    pointmap: Pointmap,
    depth: LearnedDepth,
    seen: SeenBefore,
) -> Mask:
    """[H, W] pixels of the picture that move by themselves, in regions."""
    camera = pointmap.camera
    step = max(1, camera.width // COMPARED_WIDTH)
    grid = np.s_[step // 2 :: step, step // 2 :: step]
    places = _Places(camera.pixel_centres()[grid], depth, grid, camera, seen)
    differs = _by_depths(pointmap, depth)[grid]
    matched = seen.matched[grid] & places.known
    apart = matched & places.apart(seen.matches[grid])
    differs |= apart
    if seen.before is not None:
        differs |= ~(matched & ~apart) & places.other_colours(seen)
    side = max(3, round(LEAST_WIDTHS * differs.shape[1]) | 1)
    kernel = np.ones((side, side), np.uint8)
    opened = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(cv2.dilate(opened, kernel), size, interpolation=0) > 0)


def _by_depths(pointmap: Pointmap, depth: LearnedDepth) -> Mask:
    """[H, W] pixels whose triangulated depth the learned one contradicts."""
    rho, variance = pointmap.rho, pointmap.variance
    both = depth.known & (rho > 1e-6) & (variance < UNKNOWN_VARIANCE)
    ratio = np.log(np.where(both, rho, 1.0) / np.where(both, depth.rho, 1.0))
    own = np.where(both, variance, 0.0) / np.where(both, rho, 1.0) ** 2
    allowed = DIFFERS_SIGMAS * np.sqrt(np.where(both, depth.variance, 1.0) + own)
    return np.asarray(both & (np.abs(ratio) > allowed))


class _Places:
    """Where the keyframe must have shown the pixels of a grid, by their learned depths."""

    def __init__(
        self,
        pixels: Array,  # [h, w, 2] px
        depth: LearnedDepth,
        grid: tuple[slice, slice],
        camera: CameraModel,
        seen: SeenBefore,
    ) -> None:
        self.known, self._grid = depth.known[grid], grid
        z = 1.0 / np.where(self.known, depth.rho[grid], 1.0)
        sigma = np.sqrt(np.where(self.known, depth.variance[grid], 0.0))
        rays = camera.unproject(pixels)
        at = [rays * (z * np.exp(step * sigma))[..., None] for step in ALONG]
        self._at = [seen.camera.project(seen.T.apply(points)) for points in at]
        self._sigma = MATCH_SIGMA_WIDTHS * camera.width

    def apart(
        self,
        matches: Float,  # [h, w, 2] px
    ) -> Mask:
        """[h, w] matches that lie elsewhere: off along the epipolar line by more than the depth's
        error moves them, or across it."""
        off = matches - self._at[len(ALONG) // 2]
        line = 0.5 * (self._at[-1] - self._at[0])
        reach = np.linalg.norm(line, axis=-1)
        along = (off * line).sum(-1) / np.maximum(reach, 1e-9)
        across = (off**2).sum(-1) - along**2
        variance = self._sigma**2
        distance = along**2 / (variance + reach**2) + across / variance
        return np.asarray(distance > DIFFERS_SIGMAS**2)

    def other_colours(
        self,
        seen: SeenBefore,
    ) -> Mask:
        """[h, w] pixels that the keyframe shows in other colours, wherever on its line they are."""
        assert seen.before is not None
        camera, matched = seen.camera, seen.matched[self._grid]
        before, now = (_reduce(picture, *self.known.shape) for picture in (seen.before, seen.now))
        usual = (now - _colours(before, seen.matches[self._grid], camera))[matched]
        if len(usual) == 0:
            return np.zeros_like(self.known)
        middle = np.median(usual, axis=0)
        sigma = np.maximum(MAD_TO_SIGMA * np.median(np.abs(usual - middle), axis=0), LEAST_GREY)
        least = np.full(self.known.shape, np.inf)
        for at in self._at:
            off = (now - _colours(before, at, camera) - middle) / sigma
            least = np.minimum(least, np.sqrt((off**2).mean(-1)))
        middle_at = self._at[len(ALONG) // 2]
        margin = EDGE_WIDTHS * camera.width
        size = (camera.width - margin, camera.height - margin)
        inside = ((middle_at > margin) & (middle_at < size)).all(-1)
        return np.asarray(self.known & inside & (least > DIFFERS_SIGMAS))


def _reduce(
    picture: Picture,  # [H, W, 3]
    height: int,
    width: int,
) -> Float:
    """[height, width, 3] means, a little smoothed: learned depths are not exact."""
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.0), np.float32)


def _colours(
    picture: Float,  # [h, w, 3], reduced
    pixels: npt.NDArray[np.floating],  # [h, w, 2] px of the picture before that
    camera: CameraModel,
) -> Float:
    """[h, w, 3]"""
    scale = picture.shape[1] / camera.width, picture.shape[0] / camera.height
    x, y = np.moveaxis(np.nan_to_num(pixels * scale - 0.5, nan=-1e4).clip(-1e4, 1e4), -1, 0)
    found = cv2.remap(
        picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(found, np.float32)
