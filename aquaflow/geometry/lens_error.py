"""What a calibration may have left of a lens in pictures that it undistorted.

A ray through (x, y, 1) is seen at ``exp(u) (1 + k r^2 + l r^4) (x, y) + (x0, y0)`` of the
normalised picture plane; a right calibration leaves u = k = l = x0 = y0 = 0.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

LENS_PRIOR_SIGMA = np.array([0.3, 0.3, 0.1, 0.01, 0.01])
"""Of u, k, l, x0 and y0 before anything was seen: air for water is a factor of 1.33, a strong lens
has k = 0.3, and the centre of a picture is known to a hundredth of the focal length."""

TERMS = len(LENS_PRIOR_SIGMA)
"""Numbers of a lens error: u, k, l, x0 and y0."""
ROUNDS = 15
"""Fixed-point steps of the inverse; more change less than a thousandth of a pixel."""
MIN_FACTOR = 0.1
"""Of the radial distortion: where it falls below, the model folds over."""


def seen_at(
    rays: Array,  # [N, 2] x and y at z = 1
    lens: Array,  # [5]
) -> Array:
    """[N, 2] where a camera with the error ``lens`` sees ``rays``, on the normalised plane."""
    return np.asarray(np.exp(lens[0]) * _factor(rays, lens) * rays + lens[3:])


def rays_of(
    seen: Array,  # [N, 2]
    lens: Array,  # [5]
) -> Array:
    """[N, 2] the inverse of :func:`seen_at`."""
    scaled = (seen - lens[3:]) * np.exp(-lens[0])
    rays = scaled
    for _ in range(ROUNDS):
        rays = scaled / np.maximum(_factor(rays, lens), MIN_FACTOR)
    return np.asarray(rays)


def _factor(
    rays: Array,  # [N, 2] x and y at z = 1
    lens: Array,  # [5]
) -> Array:
    """[N, 1] of the radial distortion."""
    squared = _square(rays)
    return np.asarray(1.0 + lens[1] * squared + lens[2] * squared**2)


def slope(
    rays: Array,  # [N, 2] x and y at z = 1
    lens: Array,  # [5]
) -> Array:
    """[N, 2, 2] of :func:`seen_at` by the rays."""
    growth = (2.0 * lens[1] + 4.0 * lens[2] * _square(rays))[..., None]
    bend = growth * rays[:, :, None] * rays[:, None, :]
    return np.asarray(np.exp(lens[0]) * (_factor(rays, lens)[..., None] * np.eye(2) + bend))


def by_lens(
    rays: Array,  # [N, 2] x and y at z = 1
    lens: Array,  # [5]
) -> Array:
    """[N, 2, 5] of :func:`seen_at` by the errors of the lens."""
    squared, scaled = _square(rays), np.exp(lens[0]) * rays
    radial = [_factor(rays, lens) * scaled, squared * scaled, squared**2 * scaled]
    centre = np.broadcast_to(np.eye(2), (len(rays), 2, 2))
    return np.concatenate([np.stack(radial, axis=-1), centre], axis=-1)


def _square(
    rays: Array,  # [N, 2] x and y at z = 1
) -> Array:
    """[N, 1] squared radius."""
    return np.asarray(np.sum(rays**2, axis=-1, keepdims=True))
