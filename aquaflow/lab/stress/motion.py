"""Motion that two-view geometry cannot like: no pose rather than a wrong one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.stress.case import Check, case
from aquaflow.lab.stress.swim import (
    CAMERA,
    Floor,
    clear_swim,
    film,
    on_path,
    only_these_lost,
    path,
    pose,
    sound,
    track,
)
from aquaflow.tracking.initialisation.bundle import Bundle, adjust
from aquaflow.tracking.pose.solver import PoseProblem, solve_pose

POINTS = 200
"""Of each problem, all over the picture."""


@case("motion", "tracking.initialisation.initialiser.Initialiser.ready")
def none(check: Check, seed: int) -> None:
    """The vehicle stands still: nothing is posed, nothing breaks."""
    still = clear_swim(seed)[0]
    frames = [replace(still, index=i) for i in range(8)]
    result = track(frames)
    sound(check, frames, result)
    check.true("a still camera gives no map", not result.posed)


@case("motion", "geometry.two_view.rotation_compensated_parallax_px")
def pure_rotation(check: Check, seed: int) -> None:
    """The vehicle turns on the spot: no parallax, so no map."""
    frames = film(Floor(seed), [pose((1.0, 2.0, 0.0), (0.0, 0.02 * i, 0.01 * i)) for i in range(8)])
    result = track(frames)
    sound(check, frames, result)
    check.true("a turn on the spot gives no map", not result.posed)


@case("motion", "tracking.pose.solver.solve_pose")
def rotation_after_start(check: Check, seed: int) -> None:
    """The vehicle swims, then turns on the spot: a map is there, so the turn is followed."""
    poses = path(8)
    poses += [pose(tuple(poses[-1].t), (0.0, 0.0, 0.02 * i)) for i in range(1, 5)]
    frames = film(Floor(seed), poses)
    result = track(frames)
    sound(check, frames, result)
    only_these_lost(check, result, (), share=0.9)
    on_path(check, result, poses)


@case("motion", "tracking.initialisation.initialiser.Initialiser.solve")
def forward(check: Check, seed: int) -> None:
    """Along the optical axis: the epipole lies in the middle of the picture."""
    poses = [pose((1.0, 2.0, -1.0 + 0.08 * i)) for i in range(10)]
    frames = film(Floor(seed), poses)
    result = track(frames)
    sound(check, frames, result)
    on_path(check, result, poses, bound=0.1)


@case("motion", "prior.homography.homography")
def flip_by_180_degrees(check: Check, seed: int) -> None:
    """From one frame to the next the picture is upside down."""
    poses = path(8)
    poses += [pose(tuple(T.t), (0.0, 0.0, np.pi)) for T in path(12)[8:]]
    frames = film(Floor(seed), poses)
    result = track(frames)
    sound(check, frames, result)
    only_these_lost(check, result, (), share=0.6)
    on_path(check, result, poses)


@case("motion", "tracking.tracker.Tracker._start_sub_map")
def teleport(check: Check, seed: int) -> None:
    """The next frame is five metres away: a new sub-map, and the dive goes on."""
    far = [Sim3(T.R, T.t + np.array([5.0, 3.0, 0.0])) for T in path(10)]
    frames = film(Floor(seed), path(8) + far)
    result = track(frames)
    sound(check, frames, result)
    after = [t for i, t in result.posed.items() if i >= 8]
    check.true("frames after the jump are posed", len(after) >= 5)
    check.true("they are in a sub-map of their own", all(t.sub_map > 0 for t in after))


@case("motion", "tracking.initialisation.initialiser.Initialiser._trustworthy")
def planar_scene(check: Check, seed: int) -> None:
    """A flat floor leaves the essential matrix ambiguous."""
    frames = film(Floor(seed, relief_m=0.0), path(10))
    result = track(frames)
    sound(check, frames, result)
    on_path(check, result, path(10), bound=0.05)


@case("motion", "tracking.pose.solver._summary")
def scene_at_infinity(check: Check, seed: int) -> None:
    """Points a million units away show a rotation and no translation; the quality is low."""
    rays = _rays(seed)
    truth = pose((0.1, 0.0, 0.0), (0.01, -0.02, 0.03))
    points = rays * 1e6
    pixels = CAMERA.project(truth.apply(points))
    problem = PoseProblem(
        points, np.full(len(points), 1e-14), pixels, np.ones(len(points)), CAMERA, 0.5
    )
    estimate = solve_pose(problem, Sim3.identity())
    check.true("the rotation is found", estimate is not None)
    if estimate is not None:
        check.pose("pose", estimate.T)
        check.below("rotation error in rad", float(np.abs(estimate.T.R - truth.R).max()), 1e-3)
        check.finite("covariance", estimate.covariance)
        sigma = np.sqrt(np.diag(estimate.covariance)[:3])
        check.true("the translation is said to be unknown", bool((sigma > 100.0).all()))


@case("motion", "tracking.initialisation.bundle._normalise")
def scale_of_a_tenth_millimetre(check: Check, seed: int) -> None:
    """The start is 0.1 mm large; the scale gauge makes it one."""
    _scaled_bundle(check, seed, 1e-4)


@case("motion", "tracking.initialisation.bundle._normalise")
def scale_of_100_metres(check: Check, seed: int) -> None:
    """The start is 100 m large; the scale gauge makes it one."""
    _scaled_bundle(check, seed, 1e2)


def _scaled_bundle(check: Check, seed: int, size: float) -> None:
    """Two views of points, all lengths ``size`` times those of the true scene."""
    rng = np.random.default_rng(seed)
    rays = _rays(seed)
    depth = rng.uniform(0.8, 1.6, POINTS)
    truth = [pose((0.2, 0.0, 0.05), (0.0, 0.03, 0.0)), pose((0.4, 0.1, 0.0), (0.02, 0.0, 0.0))]
    pixels = np.stack([CAMERA.project(T.apply(rays * depth[:, None])) for T in truth])
    start = Bundle(
        [Sim3(T.R, T.t * size * 1.1) for T in truth],
        1.0 / (size * depth * rng.uniform(0.9, 1.1, POINTS)),
        CAMERA,
    )
    observed = np.ones(pixels.shape[:2], dtype=bool)
    result = adjust(CAMERA.project(rays), pixels, observed, start)
    check.finite("inverse depths", result.bundle.rho, result.rho_sigma)
    for T in result.bundle.T:
        check.pose("view", T)
    check.below("median reprojection error in px", result.residual_px, 0.051)
    ratio = result.bundle.rho * depth
    check.below("spread of the depths' scale", float(ratio.std() / ratio.mean()), 1e-3)


def _rays(seed: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """[POINTS, 3] rays all over the picture."""
    rng = np.random.default_rng([seed, 1])
    pixels = np.stack([rng.uniform(2, 158, POINTS), rng.uniform(2, 118, POINTS)], -1)
    return CAMERA.unproject(pixels)
