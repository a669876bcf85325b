"""Daylight below the surface: what colour the water above the vehicle left it.

At depth D of water of one of Jerlov's types, channel c of a camera that takes surface daylight for
white gets of a grey surface

    E_c = sum S_c(w) exp(-K_d(w) D) / sum S_c(w)

over wavelengths w, with K_d the diffuse attenuation of downwelling irradiance (N. G. Jerlov, Marine
Optics, 2nd edition, Elsevier 1976, Table XXVII; those of R. W. Austin and T. J. Petzold, Spectral
dependence of the diffuse attenuation coefficient of light in ocean waters, Optical Engineering 25,
1986, differ by up to a fifth). It is not the attenuation along a camera's ray, which is two to four
times as large; that one the map's own fit knows, and its ratios between the channels tell what type
the water is. A channel is broad: at 10 m of oceanic II red has 1.9 times the light of its middle,
because what is left of it is its yellow end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config.white_balance import JERLOV_TYPES
from aquaflow.water.illuminant import Illuminant

Array = npt.NDArray[np.float64]

WAVELENGTHS_NM = np.arange(400.0, 701.0, 25.0)
K_D = np.array(
    [
        [0.027, 0.022, 0.019, 0.018, 0.027, 0.043, 0.063, 0.089, 0.235, 0.305, 0.36, 0.42, 0.56],
        [0.038, 0.031, 0.026, 0.025, 0.032, 0.048, 0.067, 0.094, 0.24, 0.31, 0.37, 0.43, 0.57],
        [0.051, 0.042, 0.036, 0.033, 0.042, 0.054, 0.072, 0.099, 0.245, 0.315, 0.375, 0.435, 0.58],
        [0.096, 0.081, 0.068, 0.062, 0.07, 0.076, 0.089, 0.115, 0.26, 0.335, 0.4, 0.465, 0.61],
        [0.185, 0.16, 0.135, 0.116, 0.115, 0.116, 0.12, 0.148, 0.295, 0.375, 0.445, 0.52, 0.66],
        [0.51, 0.36, 0.25, 0.17, 0.14, 0.13, 0.12, 0.15, 0.3, 0.37, 0.45, 0.51, 0.65],
        [0.78, 0.54, 0.39, 0.29, 0.22, 0.2, 0.19, 0.21, 0.33, 0.4, 0.46, 0.56, 0.71],
        [1.1, 0.78, 0.56, 0.43, 0.36, 0.31, 0.3, 0.33, 0.4, 0.48, 0.54, 0.65, 0.8],
        [1.6, 1.2, 0.89, 0.71, 0.58, 0.49, 0.46, 0.46, 0.48, 0.54, 0.63, 0.78, 0.92],
        [2.4, 1.9, 1.6, 1.23, 0.99, 0.78, 0.63, 0.58, 0.6, 0.65, 0.76, 0.92, 1.1],
    ]
)
"""[10, 13] 1/m, of ``JERLOV_TYPES``: Jerlov's table as two others have transcribed it, who agree in
what was seen of both, the oceanic types."""
CHANNELS_NM, CHANNEL_SIGMA_NM = np.array([600.0, 535.0, 465.0]), 30.0
"""Middle of red, green and blue, and the deviation of each: about the mean of the 28 cameras of J.
Jiang et al., What is the space of spectral sensitivity functions for digital color cameras?, WACV
2013 (from memory)."""
RESPONSE_ERROR = 0.2
"""1 sigma of a log for its size: deviations of 20 and 40 nm instead of 30 change red by 0.1 to 0.3
of it down to 20 m, and how a picture is encoded by a tenth."""
RATIO_ERROR = 0.2
"""1 sigma of the log of a channel: attenuation along a ray over K_d, but for the factor that all
channels have in common. Ratios of Li et al. (2020), which the synthetic waters have, differ from
Jerlov's by 0.07 to 0.23 (root mean square of the three channels)."""
RAY_M = 4.0
"""Length of way on which types are compared: ratios change by a tenth from 0.5 to 8 m."""
FINE_NM = np.arange(400.0, 701.0, 5.0)
LEAST = 1e-6
"""Guards the logarithm of an attenuation."""
DEEPEST_M = 200.0
"""Guards the logarithm; there is no daylight for a camera below."""
ENCODING = 1.0 / 2.2
"""Log of a picture's value for the log of its light, which sRGB has on the mean: pictures are used
as encoded (docs/conventions.md#pictures)."""


@dataclass(frozen=True)
class Depths:
    """How deep below the surface a dive was."""

    mean_m: float
    spread_m: float
    """Standard deviation."""


def type_named(water: str) -> Array:
    """[10] how likely each of ``JERLOV_TYPES`` is: the one of that name for certain.

    Raises:
        ValueError: there is no such type.
    """
    return np.asarray(np.eye(len(JERLOV_TYPES))[JERLOV_TYPES.index(water)])


def types_like(
    beta_a: Array,  # [3] attenuation along a ray, in any unit
    sigma: float,  # its relative deviation
) -> Array:
    """[10] how likely each of ``JERLOV_TYPES`` is, by the ratios of the attenuations."""
    off = np.log(np.maximum(beta_a, LEAST)) - np.log(-_log_light(RAY_M))
    off -= off.mean(axis=1, keepdims=True)
    likely = np.exp(-0.5 * (off**2).sum(axis=1) / (sigma**2 + RATIO_ERROR**2))
    return np.asarray(likely / likely.sum())


def daylight_at(
    types: Array,  # [10] how likely each of JERLOV_TYPES is
    depths: Depths,
) -> Illuminant:
    """The mean colour of daylight in such waters, as a camera that takes surface daylight for white
    encodes it. It is as sure as the likely types agree, as half of the way to their neighbours, as
    the dive's depths differ, and as cameras do."""
    depth = max(depths.mean_m, 0.0)
    logs = _logs(depth)
    of_neighbours = 0.5 * np.gradient(logs, axis=0)
    log = types @ logs
    of_types = types @ ((logs - log) ** 2 + of_neighbours**2)
    of_depths = types @ _logs(depth + depths.spread_m) - log
    of_camera = RESPONSE_ERROR * log
    return Illuminant(log, np.sqrt(of_types + of_depths**2 + of_camera**2))


def _logs(depth_m: float) -> Array:
    """[10, 3] logarithms of RGB as encoded, of mean 0, by type."""
    log = ENCODING * _log_light(min(depth_m, DEEPEST_M))
    return np.asarray(log - log.mean(axis=1, keepdims=True))


def _log_light(way_m: float) -> Array:
    """[10, 3] logarithm of the share of RGB that is left after so much water, by type."""
    response = np.exp(-0.5 * ((FINE_NM - CHANNELS_NM[:, None]) / CHANNEL_SIGMA_NM) ** 2)
    response /= response.sum(axis=1, keepdims=True)
    of_types = [np.interp(FINE_NM, WAVELENGTHS_NM, row) for row in K_D]
    return np.asarray(np.log(np.exp(-np.stack(of_types) * way_m) @ response.T))
