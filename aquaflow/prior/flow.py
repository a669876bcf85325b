"""Dense matches by DIS optical flow, refined, and checked forward against backward."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.render.library import library_or_none

Float = npt.NDArray[np.float32]
Grey = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

FILL_PX = 31
"""Square around a masked pixel whose mean it takes; eight times that where all of it is masked."""

CLAHE_CLIP = 2.0
"""OpenCV's clip limit of the histogram in each tile."""
CLAHE_TILES = (8, 8)
"""Local contrast normalisation: water takes contrast unevenly
(notes/2026-11-tracking.md#initialisation)."""

FORWARD_BACKWARD_PX = 1.0
"""A match that does not come back to within a pixel is occluded, out of view or wrong."""

OCCLUSION_PX = 0.4
"""Twice the noise of a refined match: beyond, it may be the surface in front that was matched, and
its depth is too small; depths that are handed over must come back to within this. Where they need
not, scale drifts four times as fast (synthetic survey, 20 keyframes: -1 against -5 % per 100)."""

CONFIDENCE_SIGMA_PX = 0.2
"""Of the forward-backward error of refined flow."""

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
trajectories are no more accurate (notes/2026-11-tracking.md#seeded)."""

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
    sigma_px: float = CONFIDENCE_SIGMA_PX
    """Error at which the confidence of a match has fallen to exp(-1/2)."""

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
    # No [H, W, 2] in NumPy: half the time. Not cv2.magnitude, whose last digit depends on where its
    # arrays lie in memory, so that a replay would not repeat.
    x, y = cv2.split(flow.forward - cv2.blur(flow.forward, window))
    size = np.sqrt(x * x + y * y)
    edge = cv2.dilate(size, np.ones(window, np.uint8)) * np.float32(EDGE_WEIGHT / flow.sigma_px)
    certain = np.asarray(cv2.exp(flow.error * flow.error * np.float32(-0.5 / flow.sigma_px**2)))
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


# --------------------------------------------------------------------------------------------------
# The flow from b to a, once that from a to b is known: reversed, then fitted to the pictures.
#
# Fitting from coarse to fine takes half the time of a second DIS flow. A match that was wrong is
# not confirmed by it: what is reversed there fits nothing, or something else
# (notes/2026-11-tracking.md#backward).

REVERSING_ROUNDS = 3
"""Fixed-point steps; more change less than fitting corrects."""
HALVINGS = 2
"""A step is at most a pixel of the coarsest picture, so that 4 px of a wrong reversal are mended.
Without them, occlusions are confirmed: 1 % of the matches are 4 px off, where it should be 2.5."""


def reverse(
    flow: Float,  # [H, W, 2] px, a to b
) -> Float:
    """[H, W, 2] approximate flow from b to a: the negated flow, looked up where it arrives.

    Fixed point of r(x) = -flow(x + r(x)); exact enough to start from.
    """
    height, width = flow.shape[:2]
    grid = pixel_grid(height, width)
    reversed_ = -flow
    for _ in range(REVERSING_ROUNDS):
        reversed_ = -sample(flow, grid + reversed_)
    return reversed_


def backward_flow(
    a: Grey,  # [H, W]
    b: Grey,  # [H, W]
    forward: Float,  # [H, W, 2] px, a to b
) -> Float:
    """[H, W, 2] px, b to a."""
    pictures = [(b, a)]
    for _ in range(HALVINGS):
        finer_b, finer_a = pictures[-1]
        pictures.append((halve(finer_b), halve(finer_a)))
    # What is finer than the coarsest picture is found anew in the finer ones.
    flow = reverse(of_size(forward, pictures[-1][0].shape))
    for coarse_b, coarse_a in reversed(pictures):
        flow = refine(coarse_b, coarse_a, of_size(flow, coarse_b.shape))
    return flow


# --------------------------------------------------------------------------------------------------
# Sub-pixel refinement of a dense flow: one symmetric Gauss-Newton step at full resolution.
#
# DIS stops at half the resolution: its matches err by 0.3 px, and neighbouring matches err
# together, by up to 0.09 px over a third of the picture. Depths and poses fused from such matches
# bend, and the scale drifts. The step below leaves 0.15 px, and less than 0.02 px in common.

WINDOW_SIGMA_PX = 2.0
"""Of the Gaussian window whose pixels move as one; 1.5 and 3 do about as well."""
WINDOW_PX = 13
"""Its support: out to three sigma."""
CONTRAST_WINDOW_PX = 15
"""Square in which mean and contrast are made equal: light that falls off with range, and caustics,
change more slowly than that."""
GREY_NOISE = 2.0
"""Grey levels of contrast that noise alone makes."""
LEAST_WINDOWS = 8
"""Windows along the picture's shorter side below which nothing is refined: one of them then spans
too much of the scene to move as one (64 x 48 px: the residual rises from 0.6 to 1.0 px)."""
MAX_STEP_PX = 1.0
"""The picture is linear over no more than this; DIS is seldom further off."""
SINGULAR = 1e-3
"""Relative damping of the 2 x 2 normal equations: along an edge the flow stays what it was."""

_CONTRAST_TAPS = np.full(CONTRAST_WINDOW_PX // 2 + 1, 1.0 / CONTRAST_WINDOW_PX, np.float32)
_WINDOW_TAPS = np.ascontiguousarray(
    cv2.getGaussianKernel(WINDOW_PX, WINDOW_SIGMA_PX)[WINDOW_PX // 2 :, 0], np.float32
)
"""Weights of both windows along one axis, from the middle outwards."""


def is_refinable(
    grey: Grey,  # [H, W]
) -> bool:
    """True if a window is small against the picture."""
    return bool(min(grey.shape) >= LEAST_WINDOWS * WINDOW_PX)


def refine(
    a: Grey,  # [H, W]
    b: Grey,  # [H, W]
    flow: Float,  # [H, W, 2] px, a to b
) -> Float:
    """[H, W, 2] as :func:`refine_by_opencv`, in compiled code where there is some.

    Raises:
        ValueError: the three are not of one size, or a picture is not of bytes.
    """
    library = library_or_none()
    if library is None:
        return refine_by_opencv(a, b, flow)
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    flow = np.ascontiguousarray(flow, dtype=np.float32)
    if not (a.dtype == b.dtype == np.uint8 and a.shape == b.shape == flow.shape[:2]):
        raise ValueError("refine takes two grey pictures and a flow, all of one size")
    refined = np.empty_like(flow)
    height, width = a.shape
    library.call(
        "aq_refine_flow",
        *(array.ctypes.data for array in (a, b, flow)), width, height,
        _CONTRAST_TAPS.ctypes.data, len(_CONTRAST_TAPS) - 1,
        _WINDOW_TAPS.ctypes.data, len(_WINDOW_TAPS) - 1,
        GREY_NOISE, MAX_STEP_PX, SINGULAR, refined.ctypes.data,
    )  # fmt: skip
    return refined


def refine_by_opencv(
    a: Grey,  # [H, W]
    b: Grey,  # [H, W]
    flow: Float,  # [H, W, 2] px, a to b
) -> Float:
    """[H, W, 2] the flow, moved to where b, warped by it, fits a best around every pixel.

    Gradients are the mean of both pictures' (Baker and Matthews, IJCV 2004, forwards and inverse
    step in one): noise and blur of either picture then shorten no step, and a to b errs like
    b to a. The warp carries the slope and turn of the flow; a window moves only by the remainder.
    """
    # One array for each coordinate, as OpenCV's gradients and remap want them.
    u, v = flow[..., 0].copy(), flow[..., 1].copy()
    here = _contrast_normalised(a.astype(np.float32))
    there = _contrast_normalised(_warp(b, u, v))
    gx, gy = _gradient(0.5 * (here + there))
    left = here - there
    xx, yy, xy = _window(gx * gx), _window(gy * gy), _window(gx * gy)
    xe, ye = _window(gx * left), _window(gy * left)
    damping = SINGULAR * (xx + yy) + 1e-6
    xx, yy = xx + damping, yy + damping
    inverse = 1.0 / (xx * yy - xy * xy)
    x, y = (yy * xe - xy * ye) * inverse, (xx * ye - xy * xe) * inverse
    # The step is in a; through the warp, 1 + d flow / d pixel, it becomes one in b.
    (ux, uy), (vx, vy) = _gradient(u), _gradient(v)
    x, y = x + ux * x + uy * y, y + vx * x + vy * y
    shorten = MAX_STEP_PX / np.maximum(np.sqrt(x * x + y * y), MAX_STEP_PX)
    return np.stack([u + x * shorten, v + y * shorten], -1)


def _warp(
    b: Grey,  # [H, W]
    u: Float,  # [H, W] px
    v: Float,  # [H, W] px
) -> Float:
    height, width = b.shape
    x = u + np.arange(width, dtype=np.float32)
    y = v + np.arange(height, dtype=np.float32)[:, None]
    picture = b.astype(np.float32)
    warped = cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, dtype=np.float32)


def _contrast_normalised(
    grey: Float,  # [H, W]
) -> Float:
    """[H, W] of mean 0 and contrast 1 around every pixel."""
    size = (CONTRAST_WINDOW_PX, CONTRAST_WINDOW_PX)
    mean = cv2.blur(grey, size)
    variance = np.maximum(cv2.blur(grey * grey, size) - mean * mean, 0.0)
    return np.asarray((grey - mean) / np.sqrt(variance + GREY_NOISE**2), dtype=np.float32)


def _window(
    field: Float,  # [H, W]
) -> Float:
    size = (WINDOW_PX, WINDOW_PX)
    return np.asarray(cv2.GaussianBlur(field, size, WINDOW_SIGMA_PX), dtype=np.float32)


def _gradient(
    field: Float,  # [H, W]
) -> tuple[Float, Float]:
    """Along x and along y, [H, W] each, per pixel."""
    along_x = cv2.Scharr(field, cv2.CV_32F, 1, 0, scale=1.0 / 32.0)
    along_y = cv2.Scharr(field, cv2.CV_32F, 0, 1, scale=1.0 / 32.0)
    return np.asarray(along_x, dtype=np.float32), np.asarray(along_y, dtype=np.float32)


# --------------------------------------------------------------------------------------------------
# Fields over a picture: pixel centres, and values between them.


@lru_cache(maxsize=8)
def pixel_grid(height: int, width: int) -> Float:
    """[H, W, 2] pixel centres in this package's convention (+0.5); shared, and not writable."""
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    grid = (np.stack([u, v], -1) + 0.5).astype(np.float32)
    grid.setflags(write=False)
    return grid


def length(
    field: Float,  # [..., 2]
) -> Float:
    """[...] of each vector; three times as fast as NumPy's norm over an axis of two."""
    return np.hypot(field[..., 0], field[..., 1])


def sample(
    field: Float,  # [H, W] or [H, W, C]
    pixels: Float,  # [..., 2] px
) -> Float:
    """Bilinear values of ``field`` at ``pixels``; the border is repeated outside."""
    xy = (pixels - 0.5).astype(np.float32)
    return np.asarray(
        cv2.remap(field, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    )


def halve(
    grey: npt.NDArray[np.uint8],  # [H, W]
) -> npt.NDArray[np.uint8]:
    """[H / 2, W / 2] the picture, smoothed and of half the size, rounded up."""
    return np.asarray(cv2.pyrDown(grey), dtype=np.uint8)


def half_by_area(
    grey: npt.NDArray[np.uint8],  # [H, W]
) -> npt.NDArray[np.uint8]:
    """[H / 2, W / 2] the picture at half the size, rounded down, as OpenCV's DIS makes it: from
    smoother ones, its matches come back 3 % worse."""
    height, width = grey.shape
    size = (max(width // 2, 1), max(height // 2, 1))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def of_size(
    flow: Float,  # [H, W, 2] px
    shape: tuple[int, ...],
) -> Float:
    """[h, w, 2] the flow of a picture of another size ``shape``, (h, w), in that one's pixels."""
    height, width = shape
    if flow.shape[:2] == shape:
        return flow
    # OpenCV's, for NumPy takes four times as long over an axis of two.
    growth = np.diag([width / flow.shape[1], height / flow.shape[0]])
    if flow.size < 2 * width * height:
        flow = np.asarray(cv2.transform(flow, growth), dtype=np.float32)
        return np.asarray(cv2.resize(flow, (width, height)), dtype=np.float32)
    return np.asarray(cv2.transform(cv2.resize(flow, (width, height)), growth), dtype=np.float32)
