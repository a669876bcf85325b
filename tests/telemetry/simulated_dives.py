"""Dives without pictures: a camera path with the errors of visual tracking, and telemetry."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from aquaflow.config import FusionConfig
from aquaflow.config.stage import MountingConfig
from aquaflow.geometry.alignment import align
from aquaflow.geometry.similarity import BODY_FROM_CAMERA, Sim3
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.dive import CELL_M, SimulatedDive, simulate
from aquaflow.lab.synthetic.site import site_of
from aquaflow.telemetry.camera_path import CameraPath
from aquaflow.telemetry.estimator import Estimate, estimate
from aquaflow.telemetry.telemetry import Telemetry
from aquaflow.types import KIND_OF

Array = npt.NDArray[np.float64]

NOTHING = np.zeros((0, 3))
JITTER_M = 0.001
"""White noise of a position, of a map whose ground is some metres away."""
SCALE_WANDER, WANDER_S = 0.003, 20.0
"""Relative size and correlation time of what the local scale does along a path."""
GROUND_EVERY, GROUND_SIGMA_M = 2, 0.005
"""Share and noise of the relief's cells that become points of the map."""
BESIDE_M = 3.0
"""How far beside the path the map has ground: a camera sees no more, and no beam meets more."""
TURN_RAD = np.radians(0.02)
"""Random walk of the orientation, in each root of a second."""


@dataclass(frozen=True)
class Swum:
    """A dive as the estimator sees it, and the truth about it."""

    dive: SimulatedDive
    path: CameraPath
    T_nm: Sim3
    """True similarity from the map to the world of the dive, as well as a bent map has one."""
    telemetry: Telemetry


def swum(config: SyntheticConfig, *kinds: str) -> Swum:
    """Telemetry of the given kinds, and a path in a map of a random scale."""
    dive = simulate(config)
    rng = np.random.default_rng(config.seed + 7919)
    R, p = dive.T_wc[:, :3, :3], dive.T_wc[:, :3, 3]
    dt = float(dive.times_s[1] - dive.times_s[0])
    keep = np.exp(-dt / WANDER_S)
    wander = np.zeros(len(p))
    for k in range(1, len(p)):
        fresh = np.sqrt(1.0 - keep**2) * rng.standard_normal()
        wander[k] = keep * wander[k - 1] + SCALE_WANDER * fresh
    turns = Rotation.from_rotvec(
        np.cumsum(TURN_RAD * np.sqrt(dt) * rng.standard_normal((len(p), 3)), axis=0)
    )
    steps = np.diff(p, axis=0, prepend=p[:1])
    bent = p[0] + np.cumsum(turns.apply(np.exp(wander)[:, None] * steps), axis=0)
    bent += JITTER_M * rng.standard_normal(bent.shape)
    R_bent = turns.as_matrix() @ R
    scale = float(rng.uniform(0.3, 3.0))
    path = CameraPath(dive.times_s, R_bent[0].T @ R_bent, (bent - bent[0]) @ R_bent[0] / scale)
    T_nm = align(path.p_m, p, with_scale=True).T_target_source
    return Swum(dive, path, T_nm, telemetry_of(dive, *kinds))


def telemetry_of(dive: SimulatedDive, *kinds: str) -> Telemetry:
    """What the instruments of the given kinds measured."""
    telemetry = Telemetry()
    for sample in dive.samples:
        if KIND_OF[type(sample)] in kinds:
            telemetry.add(sample)
    return telemetry


def ground_of(swum: Swum, seed: int = 0) -> Array:
    """[K, 3] points of the map: the true relief under the path, as a map with that bend has it."""
    dive = swum.dive
    site, rng = site_of(dive.config, CELL_M), np.random.default_rng(seed)
    area, heights = site.relief.area, site.crests
    rows, columns = (grid.ravel()[::GROUND_EVERY] for grid in np.indices(heights.shape))
    x = area.x0 + (columns + 0.5) * area.cell
    y = area.y0 + (rows + 0.5) * area.cell
    ground_s = np.column_stack([x, y, -heights[rows, columns].astype(np.float64)])
    ground_n = ground_s @ site.path.R_ws.T + site.path.t_ws
    ground_n += GROUND_SIGMA_M * rng.standard_normal(ground_n.shape)
    away, _ = KDTree(dive.T_wc[::5, :2, 3]).query(ground_n[:, :2], distance_upper_bound=BESIDE_M)
    return swum.T_nm.inverse().apply(ground_n[np.isfinite(away)])


def stated_mounting(dive: SimulatedDive) -> MountingConfig:
    """Of the camera, as the dive states it."""
    R_bc = dive.T_bc_stated[:3, :3]
    yaw, pitch, roll = Rotation.from_matrix(R_bc @ BODY_FROM_CAMERA.T).as_euler("ZYX", degrees=True)
    x, y, z = dive.T_bc_stated[:3, 3].tolist()
    return MountingConfig(position_m=(x, y, z), roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw)


def estimated(swum: Swum, points: Array = NOTHING, **settings: Any) -> Estimate:
    """What the estimator makes of it."""
    config = FusionConfig(**settings)
    return estimate(swum.telemetry, swum.path, config, stated_mounting(swum.dive), lambda: points)


def part_of(swum: Swum, *kinds: str) -> Swum:
    """The same dive with the instruments of the given kinds only."""
    return replace(swum, telemetry=telemetry_of(swum.dive, *kinds))


def between(path: CameraPath, first_s: float, last_s: float, scale: float) -> CameraPath:
    """A sub-map of that time: from its first camera's axes, ``scale`` units a unit."""
    kept = (path.t_s >= first_s) & (path.t_s <= last_s)
    R, p = path.R_mc[kept], path.p_m[kept]
    return CameraPath(path.t_s[kept], R[0].T @ R, scale * (p - p[0]) @ R[0])
