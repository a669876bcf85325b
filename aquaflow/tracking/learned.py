"""A learned range in a keyframe's unit, with a variance that the keyframe's own depths confirm.

A network's ranges have a unit of their own, are off by a slope across the picture, and seldom have
the error that it states. All three are found where the keyframe's depths are triangulated: scale
and slope by robust least squares, and the factor of the error by the spread that is left. Errors of
neighbours are alike, so that however many pixels are compared, they count as few. The fit is linear
but for its weights, which follow from a noise of two parts, stated and own: its loop is three lines
here, where ``optimise.minimise`` would need a problem of its own.

Networks that know inverse depth up to scale and shift get their shift there as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config.tracking import LearnedConfig
from aquaflow.geometry.camera import CameraModel, at_pixels
from aquaflow.keyframes import LearnedDepths, Pointmap
from aquaflow.optimise.least_squares import RobustFit, Rules, covariance_of, minimise
from aquaflow.optimise.robust import Tukey, sigma_of
from aquaflow.prior.contract import Float, Mask, RangeUnit

Array = npt.NDArray[np.float64]

ITERATIONS = 8
"""Of reweighting; each divides the remaining error by five or more."""
COMPARED = 4000
"""Most pixels that learned and triangulated depths are compared at."""
LEAST_COMMON = 200
"""Pixels known to both below which a unit is not found: two cells of a small picture."""
SLOPE_SIGMA = 0.1
"""Of the logarithm from the picture's middle to its edge: a slope of 6 degrees over a floor seen
straight down; a network that sees the floor's tilt errs by less."""
SHIFT_SIGMA = 0.1
"""Of what is left of a shift, over the median inverse depth: the most error that its fit allows.
"""
HONESTY = (0.5, np.inf)
"""Bounds of the factor of the stated error. A tenth of the picture may happen to fit too well; an
upper bound could leave no point within the fit's reach, and so no fit."""


@dataclass(frozen=True)
class LearnedDepth:
    """Learned inverse depths in the unit of a keyframe."""

    rho: Array
    """[H, W] 1 / z; 0 where unknown"""
    variance: Array
    """[H, W] of the logarithm of ``rho``: the network's own, grown by what the comparison showed"""
    log_scale: float
    """Logarithm of the keyframe's unit over the network's, in the middle of the picture"""
    log_scale_sigma: float
    honesty: float
    """Error found over error stated."""

    @property
    def known(self) -> Mask:
        """[H, W]"""
        return self.rho > 0.0

    @property
    def kept(self) -> LearnedDepths:
        """What a pointmap keeps of it."""
        variance = np.where(self.known, self.variance, 0.0) * self.rho**2
        return LearnedDepths(self.rho, variance, self.log_scale, self.log_scale_sigma)


def learned_depth(
    pointmap: Pointmap,
    X: Float,  # [H, W, 3] in the pointmap's camera; NaN where unknown
    Q: Float,  # [H, W] 1 / relative variance; 0 where unknown
    known_sigma: float,
    unit: RangeUnit = "shared",
) -> LearnedDepth | None:
    """The learned range in the unit of ``pointmap``, by the pixels that it knows to better than
    ``known_sigma``; None if they are too few, or contradict a range that is known up to a
    shift."""
    learned = _is_learned(X, Q)
    rows, columns = np.nonzero(learned & pointmap.is_known(known_sigma))
    if len(rows) < LEAST_COMMON:
        return None
    step = -(-len(rows) // COMPARED)
    common = rows[::step], columns[::step]
    network = _network(pointmap.camera, X, Q, learned)
    if unit == "affine":
        shift = shift_of(1.0 / network.z[common], pointmap.rho[common])
        if shift is None:
            return None
        network = _shift(network, shift)
        near = network.known[common]
        common = common[0][near], common[1][near]
        if len(common[0]) < LEAST_COMMON:
            return None
    rho = pointmap.rho[common]
    log_ratio = -np.log(rho * network.z[common])
    stated, own = network.variance[common], pointmap.variance[common] / rho**2
    A = network.A[common]
    if unit == "affine":  # by the keyframe's depths, whose errors make the line less flat
        A[:, -1] *= np.exp(log_ratio - np.median(log_ratio))
    found, covariance, honesty = _fit(network.sigmas, A, log_ratio, stated, own)
    return _apply(network, found, covariance, honesty)


def unscaled_depth(
    camera: CameraModel,
    X: Float,  # [H, W, 3]; NaN where unknown
    Q: Float,  # [H, W]; 0 where unknown
    honesty: float = 1.0,
) -> LearnedDepth | None:
    """The learned range in a unit that makes its median depth 1; None where nothing is known."""
    learned = _is_learned(X, Q)
    if learned.sum() < LEAST_COMMON:
        return None
    network = _network(camera, X, Q, learned)
    found = np.array([-np.log(float(np.median(network.z[learned]))), 0.0, 0.0])
    return _apply(network, found, np.zeros((3, 3)), honesty)


def agreement(
    depth_a: LearnedDepth,
    depth_b: LearnedDepth,
    z_in_b: Array,  # [M] depths of a's points in b
    pixels_a: Array,  # [M, 2] px
    pixels_b: Array,  # [M, 2] px of the same points
) -> float:
    """Difference of two pictures' learned depths at common points over the error that they state;
    what both pictures get wrong alike does not show."""
    rho_b = at_pixels(depth_b.rho, pixels_b)
    variance = at_pixels(depth_a.variance, pixels_a) + at_pixels(depth_b.variance, pixels_b)
    sound = (rho_b > 0.0) & (z_in_b > 0.0) & np.isfinite(variance) & (variance > 0.0)
    if sound.sum() < LEAST_COMMON:
        return HONESTY[1]
    log_ratio = np.log(z_in_b[sound] * rho_b[sound])
    left = (log_ratio - np.median(log_ratio)) / np.sqrt(variance[sound])
    return float(np.clip(sigma_of(left), *HONESTY))


def _is_learned(
    X: Float,  # [H, W, 3]
    Q: Float,  # [H, W]
) -> Mask:
    sound = np.isfinite(X).all(-1) & np.isfinite(Q)
    return np.asarray(sound & (np.where(sound, X[..., 2], 0.0) > 0.0) & (Q > 0.0))


@dataclass(frozen=True)
class _Network:
    """What the network says of a picture, and what its logarithm of depth may be off by."""

    z: Array
    """[H, W] in its own unit; NaN where unknown"""
    variance: Array
    """[H, W] of the logarithm of z, as it states"""
    A: Array
    """[H, W, k] change of log z for each correction: scale, slopes, and what a shift is off by"""
    sigmas: tuple[float, ...]
    """[k] of the corrections before anything is compared"""

    @property
    def known(self) -> Mask:
        """[H, W]"""
        return np.isfinite(self.z)


def _network(
    camera: CameraModel,
    X: Float,  # [H, W, 3]
    Q: Float,  # [H, W]
    learned: Mask,  # [H, W]
) -> _Network:
    z = np.where(learned, X[..., 2], np.nan).astype(np.float64)
    variance = 1.0 / np.where(learned, Q, 1.0).astype(np.float64)
    return _Network(z, variance, _positions(camera), (np.inf, SLOPE_SIGMA, SLOPE_SIGMA))


def _shift(network: _Network, shift: float) -> _Network:
    """With inverse depths moved by ``shift``. Such networks err by as much of the inverse depth
    near and far, so that beyond the median depth the relative error grows with depth."""
    z = shifted_depth(network.z, shift)
    relative = np.where(np.isfinite(z), z, 1.0) / float(np.nanmedian(z))
    A = np.concatenate([network.A, -relative[..., None]], -1)
    variance = network.variance * np.maximum(relative, 1.0) ** 2
    return _Network(z, variance, A, (*network.sigmas, SHIFT_SIGMA))


def _positions(camera: CameraModel) -> Array:
    """[H, W, 3]: 1, and the pixel's place from -1 to 1 across and down."""
    across = (np.arange(camera.width) + 0.5) * (2.0 / camera.width) - 1.0
    down = (np.arange(camera.height) + 0.5) * (2.0 / camera.height) - 1.0
    u, v = np.meshgrid(across, down)
    return np.stack([np.ones_like(u), u, v], -1)


def _fit(
    sigmas: tuple[float, ...],  # [k] of the corrections before
    A: Array,  # [M, k]
    log_ratio: Array,  # [M] of the keyframe's depth over the network's
    stated: Array,  # [M] variance that the network states
    own: Array,  # [M] relative variance of the keyframe's depth
) -> tuple[Array, Array, float]:
    """Corrections [k], their covariance [k, k], and the factor of the stated error."""
    found = np.zeros(A.shape[1])
    found[0] = float(np.median(log_ratio))
    honesty, share = 1.0, min(INDEPENDENT / len(A), 1.0)
    before = np.diag(np.array(sigmas) ** -2.0)
    covariance = np.eye(len(found))
    for _ in range(ITERATIONS):
        left = log_ratio - A @ found
        spread = sigma_of(left / np.sqrt(stated))
        excess = spread**2 - float(np.median(own / stated))
        honesty = float(np.clip(np.sqrt(max(excess, 0.0)), *HONESTY))
        sigma = np.sqrt(honesty**2 * stated + own)
        # False depths lie on one side: the unit would follow any part of them.
        weight = share * Tukey().weight(left / sigma) / sigma**2
        covariance = np.linalg.inv((A.T * weight) @ A + before)
        found = covariance @ ((A.T * weight) @ log_ratio)
    return found, covariance, honesty


def _apply(
    network: _Network,
    found: Array,  # [k] corrections
    covariance: Array,  # [k, k] of them
    honesty: float,
) -> LearnedDepth:
    A, known = network.A, network.known
    z = np.where(known, network.z, 1.0) * np.exp(A @ found)
    variance = honesty**2 * network.variance + ((A @ covariance) * A).sum(-1)
    return LearnedDepth(
        np.where(known, 1.0 / z, 0.0),
        np.where(known, variance, np.inf),
        float(found[0]),
        float(np.sqrt(covariance[0, 0])),
        honesty,
    )


# --------------------------------------------------------------------------------------------------
# The shift of inverse depths that a network knows up to scale and shift only.
#
# Such a network's inverse depth is d = g rho + c of the true one, rho. Where the keyframe's depths
# are triangulated, c is found by a robust line; then 1 / (d - c) is a depth of unknown unit, as
# other networks have it (scaling.py), which also finds what is left of the shift's error. The line
# is that of d over rho: rho has the smaller errors, and errors of what a line is over make it too
# flat.

LAGS = (2, 3, 5, 7)
"""Pixels are paired with those this part of the list further on: slopes of such pairs, not of
neighbours, whose errors are alike."""
LEAST_SPREAD = 0.25
"""Difference of d within a pair, over the standard deviation of all, from which it has a slope."""
MOST_ERROR = 0.1
"""Standard error of the shift over the median of d - c beyond which it is not known: depths half as
large and twice as large as the median's are then 5 and 20 % off."""
INDEPENDENT = 48
"""Errors of a network that count as independent in a picture (8 x 6 cells), as those of matches
(tracking/pose/solver.py)."""
RULES = Rules(iterations=12, sigmas=1e-2, damping=0.0)
"""Of reweighting; each iteration divides the remaining error by five or more."""
FARTHEST = 50.0
"""Depth over the median depth beyond which nothing is known: there the shift decides all."""


def shift_of(
    inverse: Array,  # [M] the network's inverse depths, d
    rho: Array,  # [M] the keyframe's
) -> float | None:
    """-c of d = g rho + c; None where d does not grow with rho, or the depths differ too little
    for the shift to be known."""
    slope = _slope_of_pairs(inverse, rho)
    if slope is None or slope <= 0.0:
        return None
    start = 1.0 / slope
    line = np.array([start, float(np.median(inverse - start * rho))])
    A = np.stack([np.ones_like(rho), 1.0 / rho], -1)  # divided by rho: errors are relative
    y = inverse / rho
    problem = RobustFit(
        residuals=lambda line: A @ line - y,
        jacobian=lambda line: A,
        kernel=Tukey(),
        expected=line,
        sigma=np.full(2, np.inf),
        least_noise=1e-9 * start,
    )
    line = minimise(problem, line, RULES).state
    share = min(INDEPENDENT / len(rho), 1.0)
    error = float(np.sqrt(covariance_of(problem.linearise(line).H)[1, 1] / share))
    level = line[0] * float(np.median(rho))
    return float(-line[1]) if level > 0.0 and error < MOST_ERROR * level else None


def shifted_depth(
    z: Array,  # [H, W] of the network; NaN where unknown
    shift: float,
) -> Array:
    """[H, W] 1 / (1 / z + shift); NaN where that is no depth or too far away to be known."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / z + shift
        inverse = np.where(inverse > 0.0, inverse, np.nan)
    if not np.isfinite(inverse).any():
        return inverse
    least = float(np.nanmedian(inverse)) / FARTHEST
    return np.asarray(np.where(inverse > least, 1.0 / inverse, np.nan))


def _slope_of_pairs(
    x: Array,  # [M]
    y: Array,  # [M]
) -> float | None:
    """Median slope (Theil and Sen) of pairs that differ; None where too few do."""
    run, rise = (
        np.concatenate([np.roll(values, len(values) // lag) - values for lag in LAGS])
        for values in (x, y)
    )
    differ = np.abs(run) > LEAST_SPREAD * x.std()
    if x.std() <= 1e-6 * np.abs(x).max() or differ.sum() < len(x) // 4:
        return None
    return float(np.median(rise[differ] / run[differ]))


# --------------------------------------------------------------------------------------------------
# What a prior knows of a keyframe's depths, kept with those that are triangulated.


def add_learned(
    pointmap: Pointmap,
    X: Float | None,  # [H, W, 3] in the pointmap's camera; NaN where unknown
    Q: Float | None,  # [H, W] 1 / relative variance; 0 where unknown
    known_sigma: float,
    config: LearnedConfig,
    unit: RangeUnit = "shared",
    before: Callable[[], Pointmap] | None = None,
) -> LearnedDepth | None:
    """Set what the prior knows of the picture in ``pointmap``, and return it; None, and no change,
    without ranges or a unit for them.

    The unit is that of the triangulated depths; where these are too few, because the camera only
    turned, that of what ``before`` gives: what the keyframe before had learned, seen from here.

    Both are kept, and no mean is taken of them: the network's error is that of a whole part of the
    picture, so that depths which are better one by one would all be moved the same way.
    """
    if not config.depth or X is None or Q is None:
        return None
    depth = learned_depth(pointmap, X, Q, known_sigma, unit)
    if depth is None and before is not None:
        depth = learned_depth(before(), X, Q, known_sigma, unit)
    if depth is not None:
        pointmap.learned = depth.kept
    return depth
