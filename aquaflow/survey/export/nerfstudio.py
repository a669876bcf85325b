"""A nerfstudio folder: transforms.json and a PLY of points, beside the pictures.

Format: nerfstudio's documentation, "Data conventions"; OpenSplat and Brush read it too. Poses are
camera to world with OpenGL's camera axes (x right, y up, z backward); the world's z is up.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.storage.atomic import atomic_write, write_json
from aquaflow.dive.point_cloud import PointCloud, PosedView
from aquaflow.dive.restored import IMAGES, picture_name
from aquaflow.geometry.camera import CameraModel

TRANSFORMS = "transforms.json"
POINTS = "points.ply"
OPENGL_FROM_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])
"""From x right, y down, z forward; its own inverse."""
POINT = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
"""Of points.ply."""
PROPERTIES = (
    *(f"float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
    *(f"uchar {name}" for name in ("red", "green", "blue")),
)


def write_nerfstudio(out: Path, views: Sequence[PosedView], cloud: PointCloud) -> None:
    """Write ``out/transforms.json`` and ``out/points.ply``, both in the upright frame.

    Raises:
        InputError: a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    write_points(out / POINTS, cloud)
    frames = [
        {
            "file_path": f"{IMAGES}/{picture_name(view.frame_index)}",
            "transform_matrix": (view.T_uc.matrix @ OPENGL_FROM_CAMERA).tolist(),
            **_intrinsics(view.camera),
        }
        for view in views
    ]
    write_json(
        out / TRANSFORMS,
        # nerfstudio's name of a camera with radtan coefficients, which are zero here
        {"camera_model": "OPENCV", "ply_file_path": POINTS, "frames": frames},
    )


def _intrinsics(camera: CameraModel) -> dict[str, Any]:
    return {
        **{"w": camera.width, "h": camera.height},
        **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }


def write_points(path: Path, cloud: PointCloud) -> None:
    """A binary PLY of the points with normals and colours.

    Raises:
        InputError: the file cannot be written.
    """
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud)}"]
    header += [f"property {each}" for each in PROPERTIES]
    with atomic_write(path) as stream:
        stream.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        for points in cloud.chunks():
            rows = np.zeros(len(points.positions), POINT)
            rows["xyz"], rows["normal"], rows["rgb"] = (
                points.positions, points.normals, points.colours
            )  # fmt: skip
            stream.write(rows.tobytes())
