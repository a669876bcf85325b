"""Where the estimator starts: a rough state in closed form, from whatever sources there are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.earth import north_east
from aquaflow.geometry.similarity import (
    BODY_FROM_CAMERA,
    Sim3,
    nearest_rotation,
    on_so3,
    rotation_from_quaternion,
)
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.telemetry import Series

Array = npt.NDArray[np.float64]

LEAST_ALIKE = 0.5
"""Correlation of a path and its fixes in the plane, below which they are of different ways, or the
one is seen from below."""
LEAST_TURN = np.radians(3.0)
"""rad; rotations about two axes of at least so much show how the camera is mounted."""


def camera_in_body(mounting: MountingConfig) -> Sim3:
    """T_bc, metres, of a camera that looks forward without angles, and down with pitch_deg -90."""
    angles = (mounting.yaw_deg, mounting.pitch_deg, mounting.roll_deg)
    R_bc = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix() @ BODY_FROM_CAMERA
    return Sim3(np.asarray(R_bc), np.array(mounting.position_m, np.float64))


def mounting_from_turns(attitude: Series, path: CameraPath) -> Array | None:
    """R_bc [3, 3] by which the camera's turns become the body's; None if it turned too little.

    With A = R_nb(i)^T R_nb(j) and B = R_mc(i)^T R_mc(j) the rotation vectors obey a = R_bc b
    (Park and Martin, IEEE Transactions on Robotics and Automation 10(5), 1994). Turns are taken
    against the mean orientation, which every sample shares.
    """
    R_nb = Rotation.from_quat(attitude.values, scalar_first=True)
    R_mc = Rotation.from_matrix(path.at(attitude.t_s)[0])
    a, b = ((R.mean().inv() * R).as_rotvec() for R in (R_nb, R_mc))
    turns = a.T @ b / len(a)
    if np.sqrt(np.linalg.svd(turns, compute_uv=False)[1]) < LEAST_TURN:
        return None
    # Turns about the two mean orientations: both are of the frames at the mean, so this is R_bc.
    return nearest_rotation(turns)


def map_to_level(
    attitude: Series,
    path: CameraPath,
    R_bc: Array,  # [3, 3]
) -> Array:
    """R_nm [3, 3] that agrees best with all attitudes: their chordal mean."""
    R_nb = rotation_from_quaternion(attitude.values)
    R_nm = R_nb @ R_bc @ np.swapaxes(path.at(attitude.t_s)[0], 1, 2)
    return nearest_rotation(R_nm.sum(axis=0))


def map_from_force(
    down_b: Array,  # [N, 3] unit vectors in the body
    t_s: Array,  # [N] s
    path: CameraPath,
    R_bc: Array,  # [3, 3]
) -> Array:
    """R_nm [3, 3] with the mean of ``down_b`` as its down, and any heading."""
    down_m = np.einsum("nij,nj->ni", path.at(t_s)[0], down_b @ R_bc)
    return level_with(down_m.mean(axis=0))


def map_from_depth(depth: Series, path: CameraPath) -> tuple[Array, float] | None:
    """R_nm [3, 3] and metres per unit from depths alone: depth = scale down . p + constant.

    None if the path does not leave a plane by enough to tell.
    """
    _, p_m = path.at(depth.t_s)
    A = p_m - p_m.mean(axis=0)
    if len(A) < 10 or np.linalg.svd(A, compute_uv=False)[-1] < 0.02 * np.sqrt(len(A)):
        return None
    down = np.linalg.lstsq(A, depth.values[:, 0] - depth.values[:, 0].mean(), rcond=None)[0]
    scale = float(np.linalg.norm(down))
    return (level_with(down), scale) if scale > 1e-6 else None


def map_from_fixes(
    fixes: Series, depth: Series | None, path: CameraPath
) -> tuple[Array, float] | None:
    """R_nm [3, 3] and metres per unit from fixes on the earth, without ``depth`` in a plane.

    None if all fixes are in one place.
    """
    latitude, longitude = fixes.values[:, :2].T
    fixes_n = north_east(latitude, longitude, (float(latitude[0]), float(longitude[0])))
    z = np.zeros(len(fixes))
    if depth is not None:
        z = np.interp(fixes.t_s, depth.t_s, depth.values[:, 0])
    try:
        T = align(path.at(fixes.t_s)[1], np.column_stack([fixes_n, z]), with_scale=True)
    except InputError:
        return None
    return T.T_target_source.R, T.T_target_source.scale


def level_with(
    down_m: Array,  # [3] in the map
) -> Array:
    """A rotation [3, 3] that takes ``down_m`` to +z by the shortest turn."""
    down = down_m / max(float(np.linalg.norm(down_m)), 1e-12)
    return np.asarray(Rotation.align_vectors([[0.0, 0.0, 1.0]], [down])[0].as_matrix())


def scale_from_velocity(velocity: Series, path: CameraPath) -> float | None:
    """Metres per unit: speed of the DVL over speed of the camera, by the root mean square."""
    ours = np.linalg.norm(path.velocity(velocity.t_s), axis=1)
    theirs = np.linalg.norm(velocity.values[:, :3], axis=1)
    moving = float((ours**2).sum())
    return float(np.sqrt((theirs**2).sum() / moving)) if moving > 0.0 else None


def scale_from_depth(
    depth: Series,
    path: CameraPath,
    R_nm: Array,  # [3, 3]
) -> float | None:
    """Metres per unit: slope of the depth over the map's own; None if it does not rise."""
    z = path.at(depth.t_s)[1] @ R_nm[2]
    z, d = z - z.mean(), depth.values[:, 0] - depth.values[:, 0].mean()
    slope = float(z @ d) / max(float(z @ z), 1e-12)
    return slope if slope > 1e-6 else None


def heading_of(
    R_nb: Array,  # [3, 3]
) -> float:
    """rad from n's x towards its y, of the body's forward axis."""
    return float(np.arctan2(R_nb[1, 0], R_nb[0, 0]))


def turned_about_down(
    R: Array,  # [3, 3]
    angle: float,
) -> Array:
    """``R`` [3, 3] after a turn of ``angle`` rad about z of its target."""
    return on_so3(np.asarray(Rotation.from_euler("z", angle).as_matrix()) @ R)


def level_fit(
    fixes_n: Array,  # [N, 2] m
    p_n: Array,  # [N, 3] level, map units
) -> tuple[float, float] | None:
    """Scale and turn about the vertical that take the path to the fixes; None if it cannot be."""
    ours, theirs = (xy - xy.mean() for xy in (p_n[:, :2] @ (1.0, 1.0j), fixes_n @ (1.0, 1.0j)))
    sizes = float(np.linalg.norm(ours)), float(np.linalg.norm(theirs))
    common = complex(np.vdot(ours, theirs))
    if min(sizes) < 1e-9 or abs(common) < LEAST_ALIKE * sizes[0] * sizes[1]:
        return None
    return abs(common) / sizes[0] ** 2, float(np.angle(common))


# --------------------------------------------------------------------------------------------------
# How wrong a source's residuals are: white noise, and parts that last.
#
# What limits telemetry is seldom its white noise: waves, the drift of an attitude filter, the drift
# of the camera's own path pass slowly, and averaging does not remove them. The residuals r [N] of a
# source are taken as Gaussian with the covariance
#
#     white^2 (diag(sigma^2) + least^2 exp(-|dt| / long) + waves^2 exp(-|dt| / wave) cos(...))
#         + size^2 exp(-|dt| / time) cos(2 pi dt / period)
#
# where sigma and the least slow part are the data sheet's, and what comes on top is the likeliest
# of some processes: Gauss-Markov of several times, and waves of several periods, which average out
# over a few of them (Rasmussen and Williams, Gaussian Processes for Machine Learning, 4.2 and 5.4).

WHITE = np.geomspace(1.0, 32.0, 16)
"""Factors tried on the data sheet's noise; more than 32 is another instrument."""
SIZES = np.concatenate([[0.0], np.geomspace(0.3, 300.0, 28)])
"""Sizes tried of the process on top, in root mean squares of the data sheet's noise."""


@dataclass(frozen=True)
class Process:
    """A kind of error that lasts."""

    time_s: float
    """Correlation time."""
    period_s: float = np.inf
    """Of a wave; infinite for a drift."""

    def correlation(
        self,
        t_s: Array,  # [N] s
    ) -> Array:
        """[N, N]"""
        dt = np.abs(np.subtract.outer(t_s, t_s))
        return np.asarray(np.exp(-dt / self.time_s) * np.cos(2.0 * np.pi * dt / self.period_s))


@dataclass(frozen=True)
class SlowPart:
    """What is known of a source's lasting errors before any residual is seen."""

    least: float
    """1 sigma of a drift that is always there, in the residual's unit (data sheet)."""
    time_s: float
    """Its correlation time."""
    processes: tuple[Process, ...]
    """What may come on top."""
    waves: float = 0.0
    """1 sigma of waves that are always there, in the residual's unit."""
    wave: Process = Process(1.0)
    """Their period, and for how long they keep it."""

    def base(
        self,
        t_s: Array,  # [N] s
        sigma: Array,  # [N] white, in the residual's unit
    ) -> Array:
        """[N, N] covariance by the data sheet."""
        drift = self.least**2 * Process(self.time_s).correlation(t_s)
        waves = self.waves**2 * self.wave.correlation(t_s)
        return np.asarray(drift + waves + np.diag(sigma**2))


@dataclass(frozen=True)
class Noise:
    """The errors of one source."""

    white: float = 1.0
    """Factor on the data sheet's noise."""
    size: float = 0.0
    """1 sigma of the process on top, in the residual's unit."""
    process: Process = Process(1.0)

    def covariance(
        self,
        t_s: Array,  # [N] s
        sigma: Array,  # [N] white, in the residual's unit
        part: SlowPart,
    ) -> Array:
        """[N, N] of one component of the residuals."""
        base = self.white**2 * part.base(t_s, sigma)
        return base + self.size**2 * self.process.correlation(t_s)


class PossibleNoise:
    """The noise that residuals at some moments may have; what depends on no residual is found once,
    for a solution asks in each of its rounds."""

    def __init__(
        self,
        t_s: Array,  # [N] s
        sigma: Array,  # [N]
        part: SlowPart,
    ) -> None:
        base = part.base(t_s, sigma)
        self._root = cholesky(base, lower=True)
        self._unit = float(np.sqrt(np.trace(base) / max(len(base), 1)))
        self._on_top: list[tuple[Process, Array, Array]] = []
        """Each process with the eigenvalues [N] and vectors [N, N] of its correlation, whitened."""
        for process in part.processes:
            half = solve_triangular(self._root, process.correlation(t_s), lower=True)
            whitened = solve_triangular(self._root, half.T, lower=True)
            self._on_top.append((process, *np.linalg.eigh(whitened)))

    def likeliest(
        self,
        r: Array,  # [N, D] residuals, D components of equal noise
    ) -> Noise:
        """The noise under which the residuals are likeliest."""
        best, found = -np.inf, Noise()
        white_r = solve_triangular(self._root, r, lower=True)
        sizes = (self._unit * SIZES) ** 2
        for process, values, vectors in self._on_top:
            power = ((vectors.T @ white_r) ** 2).sum(axis=1)
            variance = WHITE[:, None, None] ** 2 + sizes[None, :, None] * np.maximum(values, 0.0)
            fit = -0.5 * (r.shape[1] * np.log(variance) + power / variance).sum(axis=2)
            i, j = np.unravel_index(int(np.argmax(fit)), fit.shape)
            if fit[i, j] > best:
                best = float(fit[i, j])
                found = Noise(float(WHITE[i]), self._unit * float(SIZES[j]), process)
        return found
