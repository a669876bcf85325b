"""Least squares over the open numbers of the camera and the pose of the board in every picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.calibration.board import BoardImage
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.optics import pixels_of_points, rays_of_pixels, virtual_centre
from aquaflow.geometry.port import FlatPort
from aquaflow.optimise.least_squares import NormalEquations, Rules, minimise
from aquaflow.optimise.robust import sigma_of_lengths

Array = npt.NDArray[np.float64]

START_FOCALS = (0.3, 0.45, 0.65, 0.9, 1.3)
"""Focal lengths over the width at which the search starts: from a fisheye to a telephoto lens."""
POSE = 6
"""Numbers of a pose: rotation vector, translation (m)."""
POSE_STEP = 1e-5
"""rad and m, over which a pose is varied for a derivative: a few thousandths of a pixel."""
RULES = Rules(iterations=100, sigmas=1e-5, damping=1e-3)
"""A few iterations from a focal length that is right, some twenty from one that is guessed."""
FOCAL_BIAS = 1e-3
"""Relative 1 sigma of a focal length that no residual shows: OpenCV's corners of tilted boards lie
so that focal lengths come out 0.05 to 0.14 % short, measured on rendered boards of both kinds."""
OUTLIER_SIGMAS = 4.0
"""Corners that lie farther from the fit were found wrongly, and are left out of a second one."""
UNSEEN_PX = 1e4
"""Residual of a corner that the camera could not see."""


@dataclass(frozen=True)
class CalibrationFit:
    """A camera, how well its numbers are known, and what is left of every corner."""

    camera: CameraModel
    names: tuple[str, ...]
    values: Array
    """[P]"""
    sigma: Array
    """[P] 1 sigma of each, from the residuals."""
    residuals: list[Array]
    """Of each view, [N, 2] px, seen minus expected."""
    kept: list[npt.NDArray[np.bool_]]
    """Of each view, [N] False for corners that were left out."""

    @property
    def rms_px(self) -> float:
        """Root mean square error of the corners that were kept, per coordinate."""
        left = [each[keep] for each, keep in zip(self.residuals, self.kept, strict=True)]
        return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


def fit_lens(views: Sequence[BoardImage], start: CameraModel) -> CalibrationFit:
    """Find the lens of ``start``'s kind, size and port, from the best of several focal lengths.

    Raises:
        InputError: the pictures determine no such lens.
    """
    fits = []
    for share in START_FOCALS:
        focal = share * start.width
        guess = replace(start, fx=focal, fy=focal, distortion=(0.0, 0.0, 0.0, 0.0))
        poses = _poses(views, guess)
        if poses is not None:
            fits.append((_cost(views, guess, poses), guess, poses))
    if not fits:
        raise InputError(
            "no lens explains the corners of the board; check --columns, --rows and --model"
        )
    _, guess, poses = min(fits, key=lambda each: each[0])
    return _refine(views, CameraUnknowns(guess), poses)


def fit_port(views: Sequence[BoardImage], start: CameraModel) -> CalibrationFit:
    """Find the distance and the normal of ``start``'s flat port; its lens is kept.

    Raises:
        InputError: the pictures do not go with this camera.
    """
    poses = _poses(views, start)
    if poses is None:
        raise InputError(
            "the pictures of the board do not go with the camera that is given; check that its "
            "lens was calibrated in air"
        )
    return _refine(views, CameraUnknowns(start, port=True), poses)


def _poses(views: Sequence[BoardImage], camera: CameraModel) -> Array | None:
    """[V, 6] of the board as a pinhole at the virtual centre sees it; None if it does not."""
    poses, centre = [], virtual_centre(camera)
    for view in views:
        rays = rays_of_pixels(camera, view.found.pixels)[1]
        seen = rays[:, 2] > 0.0
        if seen.sum() < POSE:
            return None
        slopes = rays[seen, :2] / rays[seen, 2:]
        found, turn, shift = cv2.solvePnP(
            view.found.points_m[seen], slopes, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
        if not found:
            return None
        poses.append(np.concatenate([turn.ravel(), shift.ravel() + centre]))
    return np.array(poses)


def _cost(
    views: Sequence[BoardImage],
    camera: CameraModel,
    poses: Array,  # [V, 6]
) -> float:
    """Median distance, px, of the corners from where they are expected."""
    return float(np.median(np.abs(_residuals(views, camera, poses))))


def _residuals(
    views: Sequence[BoardImage],
    camera: CameraModel,
    poses: Array,  # [V, 6]
) -> Array:
    """[N, 2] px of all corners of all views."""
    turns = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    points = [
        view.found.points_m @ R.T + t for view, R, t in zip(views, turns, poses[:, 3:], strict=True)
    ]
    expected = pixels_of_points(camera, np.concatenate(points))
    left = np.concatenate([view.found.pixels for view in views]) - expected
    return np.where(np.isfinite(left), left, UNSEEN_PX)


def _refine(
    views: Sequence[BoardImage],
    parameters: CameraUnknowns,
    poses: Array,  # [V, 6]
) -> CalibrationFit:
    """Fit, leave out what was found wrongly, and fit again."""
    counts = [len(view.found.numbers) for view in views]
    everything = np.ones(sum(counts), bool)
    values, poses, _ = _solve(views, parameters, parameters.values(), poses, everything)
    left = np.linalg.norm(_residuals(views, parameters.camera(values), poses), axis=1)
    kept = left < OUTLIER_SIGMAS * max(sigma_of_lengths(left), 1e-3)
    values, poses, sigma = _solve(views, parameters, values, poses, kept)
    of_lens = np.array([name in {"fx", "fy"} for name in parameters.names])
    sigma = np.hypot(sigma, np.where(of_lens, FOCAL_BIAS * values, 0.0))
    camera = parameters.camera(values)
    ends = np.cumsum(counts)[:-1]
    residuals = np.split(_residuals(views, camera, poses), ends)
    return CalibrationFit(camera, parameters.names, values, sigma, residuals, np.split(kept, ends))


@dataclass(frozen=True)
class _Corners:
    """N corners in V views as a problem of least squares over the camera's P numbers and V poses.

    A state is [P + 6 V], counted in the steps of its derivatives.
    """

    views: Sequence[BoardImage]
    parameters: CameraUnknowns
    kept: npt.NDArray[np.bool_]
    """[N] corners to use."""

    @property
    def scale(self) -> Array:
        """[P + 6 V] of the steps."""
        poses = np.full(POSE * len(self.views), POSE_STEP)
        return np.concatenate([self.parameters.steps, poses])

    @property
    def rows_of(self) -> npt.NDArray[np.intp]:
        """[2 N] the view of each row of the residuals."""
        of_view = np.repeat(
            np.arange(len(self.views)), [len(view.found.numbers) for view in self.views]
        )
        return np.repeat(of_view[self.kept], 2)

    def residuals(
        self,
        x: Array,  # [P + 6 V]
    ) -> Array:
        """[2 N] px"""
        values, poses = np.split(x * self.scale, [len(self.parameters.steps)])
        camera = self.parameters.camera(values)
        left = _residuals(self.views, camera, poses.reshape(-1, POSE))
        return np.asarray(left[self.kept].ravel())

    def jacobian(
        self,
        x: Array,  # [P + 6 V]
    ) -> Array:
        """[2 N, P + 6 V] by central differences."""
        rows, size = self.rows_of, len(self.parameters.steps)
        J, unit = np.zeros((len(rows), len(x))), np.eye(size, len(x))
        for k in range(size):
            J[:, k] = self._change(x, unit[k])
        for k in range(POSE):  # no two views share a pose: all are varied at once
            step = np.zeros(len(x))
            step[size + k :: POSE] = 1.0
            J[np.arange(len(J)), size + POSE * rows + k] = self._change(x, step)
        return J

    def linearise(
        self,
        x: Array,  # [P + 6 V]
    ) -> NormalEquations:
        """The equations of a step [P + 6 V]."""
        return NormalEquations.of(self.jacobian(x), self.residuals(x))

    def cost(
        self,
        x: Array,  # [P + 6 V]
    ) -> float:
        """Half the sum of squares, px."""
        r = self.residuals(x)
        return 0.5 * float(r @ r)

    def move(
        self,
        x: Array,  # [P + 6 V]
        step: Array,  # [P + 6 V]
    ) -> Array:
        """Their sum."""
        return x + step

    def _change(
        self,
        x: Array,  # [P + 6 V]
        step: Array,  # [P + 6 V]
    ) -> Array:
        return np.asarray(0.5 * (self.residuals(x + step) - self.residuals(x - step)))


def _solve(
    views: Sequence[BoardImage],
    parameters: CameraUnknowns,
    values: Array,  # [P]
    poses: Array,  # [V, 6]
    kept: npt.NDArray[np.bool_],  # [N] corners to use
) -> tuple[Array, Array, Array]:
    """Values [P], poses [V, 6] and the sigma [P] of the values."""
    problem, size = _Corners(views, parameters, kept), len(values)
    start = np.concatenate([values, poses.ravel()]) / problem.scale
    found = minimise(problem, start, RULES).state
    rows = problem.rows_of
    views_of = [np.flatnonzero(rows == k) for k in range(len(views))]
    sigma = _sigma(problem.jacobian(found), problem.residuals(found), size, views_of)
    best = found * problem.scale
    return best[:size], best[size:].reshape(-1, POSE), sigma * problem.scale[:size]


def _sigma(
    J: Array,  # [M, P + 6 V]
    left: Array,  # [M] residuals
    size: int,
    rows_of: Sequence[npt.NDArray[np.int64]],  # [V] of each view, its rows of J
) -> Array:
    """[P] 1 sigma: the larger of what the residuals' noise gives and what the views' scatter gives.

    The errors of corners in one view go together (blur, light, a board that is not quite flat), so
    the noise alone promises too much. The scatter is the jackknife over views: how the numbers
    change where one is left out, to first order.
    """
    information, pulls = [], []
    for k, rows in enumerate(rows_of):
        mine, pose = J[rows, :size], J[rows, size + POSE * k : size + POSE * (k + 1)]
        free = mine - pose @ np.linalg.lstsq(pose, mine, rcond=None)[0]
        information.append(free.T @ free)
        pulls.append(free.T @ left[rows])
    whole = np.sum(information, axis=0)
    variance = float(left @ left) / max(len(left) - J.shape[1], 1)
    noise = variance * np.diag(np.linalg.pinv(whole, hermitian=True))
    changes = [
        np.linalg.pinv(whole - each, hermitian=True) @ pull
        for each, pull in zip(information, pulls, strict=True)
    ]
    scatter = (len(changes) - 1) / len(changes) * np.sum(np.square(changes), axis=0)
    return np.asarray(np.sqrt(np.maximum(noise, scatter)))


# --------------------------------------------------------------------------------------------------
# What a calibration estimates, as a vector: the lens, or the place of a flat port before it.

LENS = {
    "radtan": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
"""Numbers of a lens by its distortion model. A third radial term of radtan is not told from the
other two by a board that fills the picture, and goes wild where it does not."""
PORT = ("distance_m", "normal_x", "normal_y")
"""Of a flat port: its thickness and its indexes are known better than pictures show them."""


@dataclass(frozen=True)
class CameraUnknowns:
    """Which numbers of a camera are open."""

    start: CameraModel
    port: bool = False
    """The flat port's place, with a lens that is known; else the lens, with what port there is."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, in their order."""
        return PORT if self.port else LENS[self.start.distortion_model]

    @property
    def steps(self) -> Array:
        """[P] over which numbers are varied for a derivative: a few thousandths of a pixel."""
        if self.port:
            return np.array([1e-5, 1e-5, 1e-5])
        return np.array([1e-2, 1e-2, 1e-2, 1e-2, 1e-5, 1e-5, 1e-5, 1e-5])

    def values(self) -> Array:
        """[P] of the start."""
        if self.port:
            port = self.start.port
            assert isinstance(port, FlatPort)
            return np.array([port.distance_m, *port.normal[:2]])
        camera = self.start
        return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients[:4]])

    def camera(
        self,
        values: Array,  # [P]
    ) -> CameraModel:
        """The camera that has these numbers."""
        if self.port:
            port = self.start.port
            assert isinstance(port, FlatPort)
            distance, x, y = values.tolist()
            normal = (x, y, float(np.sqrt(max(1.0 - x * x - y * y, 0.0))))
            return replace(self.start, port=replace(port, distance_m=distance, normal=normal))
        fx, fy, cx, cy, *distortion = values.tolist()
        return replace(self.start, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))
