"""Simulated rotations: of a vehicle along a synthetic dive's path or at random, and what a camera
and its instruments make of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.path import plan_path
from aquaflow.telemetry.time_offset import TimeOffset
from aquaflow.telemetry.turns import Turns

Array = npt.NDArray[np.float64]

GYRO_HZ, GYRO_SIGMA_RAD_S, GYRO_BIAS_RAD_S = 50.0, 0.002, 0.005
"""BlueROV2 grade, as of synthetic.config.TelemetryNoise; a bias as MEMS gyros have."""
ATTITUDE_HZ, ATTITUDE_SIGMA_RAD = 20.0, np.radians(0.5)


def random_rotation(rng: np.random.Generator) -> Array:
    return np.asarray(Rotation.random(rng=rng).as_matrix())


def shaken(R: Array, sigma_rad: float, rng: np.random.Generator) -> Array:
    """Orientations [N, 3, 3] with white noise."""
    noise = Rotation.from_rotvec(sigma_rad * rng.standard_normal((len(R), 3)))
    return np.asarray(R @ noise.as_matrix())


@dataclass(frozen=True)
class Case:
    """A dive whose video and log were never synchronised."""

    camera: Turns
    body: Turns
    R_cb: Array
    offset_s: float
    drift: float

    def error_s(self, found: TimeOffset) -> float:
        return found.offset_s - (self.offset_s + self.drift * found.middle_s)


def dive(seed: int, seconds: float = 60.0, attitudes: bool = False) -> Case:
    """A synthetic dive at 10 to 30 frames/s with 0.05 to 0.2 degrees of noise a pose; the mounting
    is unknown, and the log covers most of the video, with a part missing at either end.

    The path's sway repeats itself every 30 s, with two axes reversed; what no vehicle does. So the
    vehicle goes along it now faster, now slower.
    """
    rng = np.random.default_rng(seed)
    fps = float(rng.uniform(10.0, 30.0))
    scenes = ("reef", "pool", "survey")
    config = SyntheticConfig.model_validate(
        {"seed": seed, "scene": scenes[seed % 3], "fps": fps, "frames": int((seconds + 10) * fps)}
    )
    path, t = plan_path(config, rng), np.arange(int(seconds * fps)) / fps
    nodes = np.arange(-10.0, seconds + 20.0, 8.0)
    progress = CubicSpline(nodes, nodes + 5.0 + 0.8 * rng.uniform(-1.0, 1.0, len(nodes)))
    pose_sigma = np.radians(rng.uniform(0.05, 0.2))
    camera = Turns.of_orientations(t, shaken(path.R_wc(progress(t)), pose_sigma, rng))
    offset_s, drift = float(rng.uniform(-100.0, 100.0)), float(rng.normal(0.0, 3e-5))
    first, last = rng.uniform(0.0, 0.2 * seconds), rng.uniform(0.8 * seconds, seconds)
    R_mb = random_rotation(rng)  # the log's axes are not those of the path's body
    at = np.arange(first, last, 1.0 / (ATTITUDE_HZ if attitudes else GYRO_HZ))
    stamps = (at - offset_s) / (1.0 + drift)
    if attitudes:
        R_wm = shaken(path.R_wb(progress(at)), ATTITUDE_SIGMA_RAD, rng) @ R_mb.T
        body = Turns.of_orientations(stamps, R_wm)
    else:
        rate = path.rate_b(progress(at)) * progress(at, 1)[:, None]
        noise = GYRO_SIGMA_RAD_S * rng.standard_normal((len(at), 3))
        bias = GYRO_BIAS_RAD_S * rng.standard_normal(3)
        body = Turns.of_rates(stamps, (rate + noise + bias) @ R_mb.T)
    return Case(camera, body, path.R_bc.T @ R_mb.T, offset_s, drift)


def random_rates(rng: np.random.Generator, t: Array, rms_rad_s: float = 0.09) -> Array:
    """[N, 3] rad/s at equal steps: what currents and a pilot do, slower than half a second."""
    rate = gaussian_filter1d(rng.standard_normal((len(t), 3)), 0.5 / (t[1] - t[0]), axis=0)
    return np.asarray(rate * (rms_rad_s / rate.std()))


def orientations(
    t: Array,  # [N] s, equal steps
    rate_rad_s: Array,  # [N, 3]
) -> Array:
    """[N, 3, 3] of what turns at these rates; the identity first."""
    mean = 0.5 * (rate_rad_s[:-1] + rate_rad_s[1:])
    R = np.empty((len(t), 3, 3))
    R[0] = np.eye(3)
    for k, turn in enumerate(Rotation.from_rotvec(mean * (t[1] - t[0])).as_matrix()):
        R[k + 1] = R[k] @ turn
    return R


def seen(
    rng: np.random.Generator,
    t: Array,  # [N] s
    rate_rad_s: Array,  # [N, 3]
    R_cb: Array,  # [3, 3]
    every: int = 4,
    sigma_rad: float = np.radians(0.1),
) -> Turns:
    """What a camera sees of these rates, one frame every so many steps."""
    R_wc = orientations(t, rate_rad_s)[::every] @ R_cb.T
    return Turns.of_orientations(t[::every], shaken(R_wc, sigma_rad, rng))
