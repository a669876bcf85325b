"""Dive folders for tests of sites: of keyframes that are stated, and of two synthetic dives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from aquaflow.base.storage.dive_status import DiveState, DiveStatus
from aquaflow.dive.tum import write_tum
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import EDGE, NAME, KeyframePlace, KeypointDepths, write_places
from aquaflow.prior.contract import Keypoints
from aquaflow.telemetry.metric_file import write_metric_file
from aquaflow.telemetry.world_frame import WorldFrame

CAMERA = CameraModel(320, 240, 270.0, 270.0, 160.0, 120.0)
POINTS = 1500
SPACING = 0.25
"""Of the keyframes of a stated dive, along x; the scene lies 1.5 in front of them."""


class Scene:
    """Points on a rough floor, each with a descriptor of its own."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.points = np.column_stack(
            [rng.uniform(-2.0, 4.0, POINTS), rng.uniform(-1.5, 1.5, POINTS),
             1.5 + 0.3 * rng.normal(size=POINTS)]
        )  # fmt: skip
        self.descriptors = np.floor(rng.gamma(0.5, 40.0, (POINTS, 128))).astype(np.float32)

    def seen(self, T_wc: Sim3, rng: np.random.Generator) -> KeypointDepths:
        """What a camera at ``T_wc`` sees, in the unit of its scale."""
        points = T_wc.inverse().apply(self.points)
        pixels = CAMERA.project(points) + rng.normal(0.0, 0.3, (len(points), 2))
        inside = (points[:, 2] > 0.1) & (pixels > 1.0).all(1) & (pixels < (319.0, 239.0)).all(1)
        rho = 1.0 / points[inside, 2] * np.exp(rng.normal(0.0, 0.01, inside.sum()))
        noise = rng.normal(0.0, 3.0, (int(inside.sum()), 128))
        descriptors = np.maximum(np.rint(self.descriptors[inside] + noise), 0.0)
        keypoints = Keypoints(pixels[inside].astype(np.float32), descriptors.astype(np.float32))
        return KeypointDepths(CAMERA, keypoints, rho, (0.02 * rho) ** 2)


def stated_dive(
    folder: Path,
    scene: Scene,
    start: float = 0.0,
    count: int = 6,
    world: Sim3 | None = None,
    seed: int = 0,
    frame: WorldFrame | None = None,
    sub_maps: Sequence[int] | None = None,
) -> Path:
    """A finished dive along x from ``start``; ``world``: T_ms, from the scene's world to the map's.
    ``sub_maps``: of each keyframe."""
    rng, T_ms = np.random.default_rng(seed), world or Sim3.identity()
    numbers = list(sub_maps or [0] * count)
    poses = [
        Sim3.exp(np.array([start + SPACING * i, 0.0, 0.0, 0.0, 0.0, 0.02 * i, 0.0]))
        for i in range(count)
    ]
    seen = [scene.seen(T, rng) for T in poses]
    in_m = [T_ms @ T for T in poses]
    places = [KeyframePlace(i, i, numbers[i], 10**9 * i, in_m[i], CAMERA) for i in range(count)]
    links = [(i + 1, i) for i in range(count - 1) if numbers[i] == numbers[i + 1]]
    edges = np.zeros(len(links), EDGE)
    for row, (a, b) in zip(edges, links, strict=True):
        T_ab = in_m[a].inverse() @ in_m[b]
        row["a"], row["b"], row["R"], row["t"], row["scale"] = a, b, T_ab.R, T_ab.t, T_ab.scale
    edges["information"], edges["trust"] = np.eye(7) / 0.003**2, 1.0
    folder.mkdir(parents=True)
    write_places(folder / NAME, zip(places, seen, strict=True), edges)
    metric = frame or WorldFrame.unknown()
    write_metric_file(folder, dict.fromkeys(sorted(set(numbers)), metric), 0)
    in_n = [metric.T_nm @ T for T in in_m]
    write_tum(
        folder / "trajectory.tum", np.arange(count, dtype=float),
        np.array([T.t for T in in_n]), np.array([T.quaternion for T in in_n]),
    )  # fmt: skip
    rows = [f"{i},x,{float(i):.9f},keyframe,{numbers[i]},{i},1.000," for i in range(count)]
    header = "index,source,t_s,class,sub_map,keyframe,quality,reason"
    (folder / "frames.csv").write_text("\n".join([header, *rows]) + "\n")
    DiveStatus(DiveState.FINISHED).write(folder)
    (folder / "metrics.json").write_text("{}")
    return folder
