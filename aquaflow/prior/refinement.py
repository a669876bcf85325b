"""Sub-pixel refinement of a dense flow: one symmetric Gauss-Newton step at full resolution.

DIS stops at half the resolution: its matches err by 0.3 px, and neighbouring matches err together,
by up to 0.09 px over a third of the picture. Depths and poses fused from such matches bend, and the
scale drifts. The step below leaves 0.15 px, and less than 0.02 px in common.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.render.library import library_or_none

Float = npt.NDArray[np.float32]
Grey = npt.NDArray[np.uint8]

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
