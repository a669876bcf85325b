"""The colour of the light in which a scene without its water stands, estimated from its pictures.

Nothing in a picture is known to be grey, so three methods are asked, each of which assumes that
something in the scene is grey on the mean, and the median of what they say is taken:

- shades of grey (Finlayson and Trezzi, Shades of Gray and Colour Constancy, CIC 2004): the
  Minkowski mean of the colours, of order 6;
- grey edge (van de Weijer, Gevers and Gijsenij, Edge-Based Color Constancy, IEEE Transactions on
  Image Processing 16, 2007): the same of the gradients' magnitudes, over one pixel;
- bright pixels (Joze, Drew, Finlayson and Troncoso Rey, The Role of Bright Pixels in Illumination
  Estimation, CIC 2012): the mean of the brightest twentieth, which on a sea floor is sand, shells
  and dead coral.

Grey world (order 1) is not asked: algae and open water make it green or blue. A pixel counts by how
far it can be relied on, and by how near it is: there the water between errs least.

The gain that makes the light grey is, channel by channel, what is likeliest given that the camera's
white balance is off by ``CAMERA_ERROR`` (1 sigma in the log) and the estimate by its own deviation
s: a share 1 / (1 + (s / CAMERA_ERROR)^2) of the log-gain that the estimate asks for. s contains the
noise of the channel's own light. A channel that holds only noise keeps the camera's gain: with
light x (share of full scale) where the others have 0.3, and noise of 0.01, the log-gain is
log(0.3 / x) / (1 + (0.02 / x)^2). The channel is amplified sixfold over the others at most, at
x = 0.03, and not at all where there is less and less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.water.white_balance import Rgb

Array = npt.NDArray[np.float64]

MINKOWSKI = 6.0
"""Order of the means: Finlayson and Trezzi's best."""
EDGE_PX = 1.0
"""Deviation of the Gaussian that gradients are taken over."""
BRIGHT_SHARE = 0.05
"""Of the weight of a picture's pixels, the brightest."""
CAMERA_ERROR = 0.5
"""1 sigma of the log of a channel of a camera's white balance under water: 0.3 to 0.5 in red on the
reef clip and on synthetic dives in green water, 0.1 on IUI3."""
SCENE_ERROR = 0.1
"""1 sigma of the log of a channel by which scenes are not the grey that all three methods hold them
to be, so that their agreement does not show it: 0.05 by the sand of the reef clip, 0.07 and 0.09
on a synthetic reef and wall, 0.12 by Curasao's colour chart. A hull all of one paint is beyond."""
LEAST = 1e-4
"""Below it a channel is black."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of RGB (ITU-R BT.709)."""


@dataclass(frozen=True)
class Illuminant:
    """The colour of the light, in the white balance that pictures were shown in."""

    log: Array
    """[3] natural logarithm of RGB, of mean 0."""
    sigma: Array
    """[3] its deviation."""


def methods_in(
    picture: npt.NDArray[np.floating],  # [H, W, 3]
    weight: npt.NDArray[np.floating],  # [H, W]; 0: not looked at
) -> Array | None:
    """[3, 3] what each method says of one picture, as logarithms of RGB of mean 0; None where it
    shows too little, or a channel is black."""
    used = weight > 0.0
    colours, of_pixels = picture[used].astype(np.float64), weight[used].astype(np.float64)
    if not len(colours):
        return None
    inside = cv2.erode(used.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    edges = _gradient(np.where(used[..., None], picture, 0.0).astype(np.float32))
    found = np.stack(
        [
            _minkowski(colours, of_pixels),
            _minkowski(edges[inside].astype(np.float64), weight[inside].astype(np.float64)),
            _brightest(colours, of_pixels),
        ]
    )
    if not np.isfinite(found).all() or found.min() < LEAST:
        return None
    logs = np.log(found)
    return np.asarray(logs - logs.mean(axis=1, keepdims=True))


def _minkowski(
    values: Array,  # [N, 3]
    weights: Array,  # [N]
) -> Array:
    total = weights.sum()
    if total <= 0.0:
        return np.full(3, np.nan)
    return np.asarray((weights @ values**MINKOWSKI / total) ** (1.0 / MINKOWSKI))


def _gradient(
    picture: npt.NDArray[np.float32],  # [H, W, 3]
) -> npt.NDArray[np.float32]:
    smooth = cv2.GaussianBlur(picture, (0, 0), EDGE_PX)
    return np.hypot(cv2.Sobel(smooth, -1, 1, 0), cv2.Sobel(smooth, -1, 0, 1)).astype(np.float32)


def _brightest(
    colours: Array,  # [N, 3]
    weights: Array,  # [N]
) -> Array:
    order = np.argsort(-(colours @ LUMINANCE))
    passed = np.cumsum(weights[order])
    chosen = order[: 1 + int(np.searchsorted(passed, BRIGHT_SHARE * passed[-1]))]
    return np.asarray(np.average(colours[chosen], axis=0, weights=weights[chosen]))


def illuminant_of(
    found: Sequence[Array],  # of V pictures [3, 3], as methods_in gives them
    weights: Sequence[float],  # [V]
) -> Illuminant | None:
    """The light of all pictures, and its deviation: between methods, and between pictures; None
    without one."""
    if not found:
        return None
    of_views = np.stack(found)
    of_methods = np.average(of_views, axis=0, weights=weights)
    log = np.median(of_methods, axis=0)
    between = np.median(of_views, axis=1).std(axis=0)
    return Illuminant(log - log.mean(), np.hypot(of_methods.std(axis=0), between))


def gain_to_grey(
    light: Illuminant,
    noise: Array,  # [3] relative deviation of a channel by the noise of its own light
    mean: Array,  # [3] of the scene's colours in the light
    scene_error: float = 0.0,
) -> tuple[Rgb, Rgb]:
    """Gain by which the light becomes grey, as far as its certainty goes, and the scene's mean
    luminance stays; and the relative deviation of the gain, to which a ``scene_error`` adds."""
    variance = light.sigma**2 + noise**2
    share = 1.0 / (1.0 + variance / CAMERA_ERROR**2)
    # How light the scene is, is no part of the light's colour: the generalised least squares mean.
    gain = np.exp(-share * (light.log - share @ light.log / share.sum()))
    gain = gain * (mean @ LUMINANCE) / max(float((gain * mean) @ LUMINANCE), LEAST)
    sigma = np.sqrt(variance * share + scene_error**2)
    return _rgb(gain), _rgb(sigma)


def _rgb(
    values: Array,  # [3]
) -> Rgb:
    red, green, blue = values.tolist()
    return red, green, blue
