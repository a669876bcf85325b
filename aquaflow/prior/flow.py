"""Dense matches by DIS optical flow, refined, and checked forward against backward."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.prior.backward_flow import backward_flow, reverse
from aquaflow.prior.fields import half_by_area, halve, length, of_size, pixel_grid, sample
from aquaflow.prior.refinement import is_refinable, refine
from aquaflow.render.library import library_or_none

Float = npt.NDArray[np.float32]
Grey = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

FILL_PX = 31
"""Square around a masked pixel whose mean it takes; eight times that where all of it is masked."""

CLAHE_CLIP = 2.0
"""OpenCV's clip limit of the histogram in each tile."""
CLAHE_TILES = (8, 8)
"""Local contrast normalisation: water takes contrast unevenly (notes/measurements.md)."""

FORWARD_BACKWARD_PX = 1.0
"""A match that does not come back to within a pixel is occluded, out of view or wrong."""

OCCLUSION_PX = 0.4
"""Twice the noise of a refined match: beyond, it may be the surface in front that was matched, and
its depth is too small; depths that are handed over must come back to within this. Where they need
not, scale drifts four times as fast (synthetic survey, 20 keyframes: -1 against -5 % per 100)."""

CONFIDENCE_SIGMA_PX = 0.2
"""Forward-backward error at which a match's confidence has fallen to exp(-1/2)."""

EDGE_WINDOW_PX = 7
"""Half of a refined match's window to either side: an edge of the depth within it is in the match,
and what is behind takes on some of the motion of what is in front."""

EDGE_WEIGHT = 2.0
"""Error of a match per pixel that the flow around departs from its mean. Without it far points of a
forward view come out 1.4 % near, with it 0.9 %, and the scale drifts -6 against -4 % per 100
keyframes (synthetic reef, 25 degrees down; 42 degrees down: -2.2 against -0.1 %)."""

MIN_TEXTURE = 30.0
"""Smoothed squared Sobel gradient of the normalised grey image below which flow only guesses."""

QUARTER_SCALE = 2
"""DIS is given pictures halved so often where the last matches are known; its matches are then
fitted at half and at all of the size. To half the size DIS costs three times as much, and
trajectories are no more accurate (notes/measurements.md#seeded)."""

HALF_SIZE_FITS = 2
"""Times that such a flow is fitted at half the size: once, trajectories err by a quarter more."""

BORDER_PX = 2.0
"""Matches this near to the rim of the picture are rejected."""


@dataclass(frozen=True)
class ImageFlow:
    """Displacements in pixels, both ways, and which pixels of a are valid."""

    forward: Float
    """[H, W, 2] from a to b."""
    backward: Float
    """[H, W, 2] from b to a."""
    error: Float
    """[H, W] px, forward-backward."""
    valid: npt.NDArray[np.bool_]
    """[H, W]"""

    @property
    def share(self) -> float:
        """Part of the picture that is matched."""
        return int(np.count_nonzero(self.valid)) / self.valid.size


def normalised_grey(
    image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    mask: Mask | None = None,  # [H, W] True where the scene is seen
) -> Grey:
    """[H, W] grey with local contrast equalised; smooth where it is masked, for an overlay's edges
    would hold the flow around it."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    if mask is not None:
        grey = _smoothly_filled(grey, mask)
    clahe = cv2.createCLAHE(CLAHE_CLIP, CLAHE_TILES)
    return np.asarray(clahe.apply(grey), dtype=np.uint8)


def _smoothly_filled(
    grey: Grey,  # [H, W]
    mask: Mask,  # [H, W]
) -> Grey:
    """[H, W] with the mean of what is seen around in place of what is masked."""
    seen = mask.astype(np.float32)
    filled, known = grey * seen, seen
    for side in (FILL_PX, 8 * FILL_PX):
        around = cv2.blur(known, (side, side))
        mean = cv2.blur(filled, (side, side)) / np.maximum(around, 1e-6)
        here = (known == 0.0) & (around > 1e-6)
        filled, known = np.where(here, mean, filled), np.where(here, 1.0, known)
    return np.asarray(np.rint(filled), dtype=np.uint8)


def texture(
    grey: Grey,  # [H, W]
    mask: Mask | None = None,  # [H, W] True where the scene is seen
) -> Float:
    """[H, W] smoothed squared gradient: what flow can hold on to; 0 where it is masked."""
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0)
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    smooth = np.asarray(cv2.GaussianBlur(dx * dx + dy * dy, (0, 0), 2.0), dtype=np.float32)
    return smooth if mask is None else np.where(mask, smooth, np.float32(0.0))


def confidence(
    flow: ImageFlow,
) -> Float:
    """[H, W] in [0, 1]: falls with the forward-backward error, and towards edges of the flow.

    The mean around a pixel is the flow itself where that is affine, however much it turns or grows.
    """
    window = (EDGE_WINDOW_PX, EDGE_WINDOW_PX)
    # In OpenCV's vectors, and no [H, W, 2] in NumPy: half the time.
    size = cv2.magnitude(*cv2.split(flow.forward - cv2.blur(flow.forward, window)))
    edge = cv2.dilate(size, np.ones(window, np.uint8)) * np.float32(
        EDGE_WEIGHT / CONFIDENCE_SIGMA_PX
    )
    certain = np.asarray(
        cv2.exp(flow.error * flow.error * np.float32(-0.5 / CONFIDENCE_SIGMA_PX**2))
    )
    return np.asarray(certain * flow.valid / (1.0 + edge * edge), dtype=np.float32)


def check(
    forward: Float,  # [H, W, 2] px, a to b
    backward: Float,  # [H, W, 2] px, b to a
    texture_a: Float,  # [H, W]
    texture_b: Float,  # [H, W]
) -> tuple[Float, Mask]:
    """As :func:`check_by_numpy`, in compiled code where there is some.

    Raises:
        ValueError: the four are not of one size.
    """
    library = library_or_none()
    if library is None:
        return check_by_numpy(forward, backward, texture_a, texture_b)
    given = [
        np.ascontiguousarray(each, np.float32) for each in (forward, backward, texture_a, texture_b)
    ]
    height, width = forward.shape[:2]
    if any(each.shape[:2] != (height, width) for each in given):
        raise ValueError("check takes two flows and two textures, all of one size")
    error, valid = np.empty((height, width), np.float32), np.empty((height, width), np.bool_)
    library.call(
        "aq_check_flow",
        *(each.ctypes.data for each in given), width, height,
        BORDER_PX, FORWARD_BACKWARD_PX, MIN_TEXTURE, error.ctypes.data, valid.ctypes.data,
    )  # fmt: skip
    return error, valid


def check_by_numpy(
    forward: Float,  # [H, W, 2] px, a to b
    backward: Float,  # [H, W, 2] px, b to a
    texture_a: Float,  # [H, W]
    texture_b: Float,  # [H, W]
) -> tuple[Float, Mask]:
    """[H, W] px by which a match does not come back, and [H, W] True where it counts."""
    height, width = texture_a.shape
    target = pixel_grid(height, width) + forward
    error = length(forward + sample(backward, target))
    inside = (target[..., 0] > BORDER_PX) & (target[..., 0] < width - BORDER_PX)
    inside &= (target[..., 1] > BORDER_PX) & (target[..., 1] < height - BORDER_PX)
    # Both ends: onto a black picture DIS flows nowhere, and comes back from there exactly.
    textured = (texture_a > MIN_TEXTURE) & (sample(texture_b, target) > MIN_TEXTURE)
    return error, np.asarray(inside & (error < FORWARD_BACKWARD_PX) & textured)


class FlowMatcher:
    """Refined DIS flow from a starting flow, and the flow back, with the forward-backward check."""

    def __init__(self) -> None:
        # Several, because OpenCV keeps a starting flow for later calls that give none; it even
        # reads beyond it when those pictures are larger. Any: its stubs do not know of None.
        self._unseeded: Any = cv2.DISOpticalFlow.create(cv2.DISOpticalFlow_PRESET_MEDIUM)
        self._seeded: Any = cv2.DISOpticalFlow.create(cv2.DISOpticalFlow_PRESET_MEDIUM)
        self._coarse: Any = cv2.DISOpticalFlow.create(cv2.DISOpticalFlow_PRESET_MEDIUM)
        self._coarse.setFinestScale(0)  # of pictures that are small already

    def __call__(
        self,
        a: Grey,  # [H, W]
        b: Grey,  # [H, W]
        texture_a: Float,  # [H, W]
        texture_b: Float,  # [H, W]
        start: Float | None = None,  # [H, W, 2] px, a to b
        quick: bool = False,
    ) -> ImageFlow:
        """``quick``: in half the time, for a start that is seldom far off."""
        # Where a start is NaN, OpenCV reads outside of the picture and ends the process.
        start = None if start is None or not np.isfinite(start).all() else start
        forward, backward = self._both_ways(a, b, start, quick)
        return ImageFlow(forward, backward, *check(forward, backward, texture_a, texture_b))

    def _both_ways(
        self,
        a: Grey,  # [H, W]
        b: Grey,  # [H, W]
        start: Float | None,  # [H, W, 2] px, a to b
        quick: bool,
    ) -> tuple[Float, Float]:
        if is_refinable(a):
            if quick and start is not None and is_refinable(a[::2, ::2]):
                flow = self._from_coarse(a, b, start)
            else:
                flow = self._flow(a, b, start)
            forward = refine(a, b, flow)
            return forward, backward_flow(a, b, forward)
        back = None if start is None else reverse(start)
        return self._flow(a, b, start), self._flow(b, a, back)

    def _from_coarse(
        self,
        a: Grey,  # [H, W]
        b: Grey,  # [H, W]
        start: Float,  # [H, W, 2] px, a to b
    ) -> Float:
        """DIS down to a quarter of the size, fitted at half of it."""
        half_a, half_b = halve(a), halve(b)
        small_a, small_b = a, b
        for _ in range(QUARTER_SCALE):
            small_a, small_b = half_by_area(small_a), half_by_area(small_b)
        initial = np.array(of_size(start, small_a.shape), dtype=np.float32, order="C")
        flow = np.asarray(self._coarse.calc(small_a, small_b, initial), dtype=np.float32)
        flow = of_size(flow, half_a.shape)
        for _ in range(HALF_SIZE_FITS):
            flow = refine(half_a, half_b, flow)
        return of_size(flow, a.shape)

    def _flow(
        self,
        a: Grey,  # [H, W]
        b: Grey,  # [H, W]
        start: Float | None,  # [H, W, 2] px, a to b
    ) -> Float:
        if start is None:
            return np.asarray(self._unseeded.calc(a, b, None), dtype=np.float32)
        initial = np.ascontiguousarray(start, dtype=np.float32).copy()
        return np.asarray(self._seeded.calc(a, b, initial), dtype=np.float32)
