"""A camera's calibration as a file that :func:`aquaflow.geometry.camera.load_camera` reads."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from aquaflow.base.storage.atomic import atomic_write, write_yaml
from aquaflow.geometry.camera import CameraModel


def save_camera(camera: CameraModel, path: Path, comment: str = "") -> None:
    """Write ``camera`` to ``path``, after a ``comment`` of one line.

    Raises:
        InputError: the file cannot be written.
    """
    data = asdict(camera) | {"distortion": list(camera.distortion), "model": "pinhole"}
    del data["calibrated"]
    data["port"] = "none" if camera.port is None else _plain(asdict(camera.port))
    write_yaml(path, data, comment)


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def save_for_others(camera: CameraModel, folder: Path) -> list[Path]:
    """Write ``camera_ros.yaml`` and ``camera_opencv.yaml``, as ROS (camera_info_manager) and
    OpenCV's FileStorage read them; their pixel centres are integers. A port is in neither.

    Raises:
        InputError: a file cannot be written.
    """
    fisheye = camera.distortion_model == "fisheye"
    cx, cy = camera.cx - 0.5, camera.cy - 0.5
    k = [camera.fx, 0.0, cx, 0.0, camera.fy, cy, 0.0, 0.0, 1.0]
    d = [float(value) for value in camera.distortion] or [0.0] * (4 if fisheye else 5)
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    matrix = {"rows": 3, "cols": 3, "data": k}
    usual = "plumb_bob" if len(d) <= 5 else "rational_polynomial"
    size = {"image_width": camera.width, "image_height": camera.height}
    ros = folder / "camera_ros.yaml"
    write_yaml(
        ros,
        size
        | {
            "camera_name": "camera",
            "camera_matrix": matrix,
            "distortion_model": "equidistant" if fisheye else usual,
            "distortion_coefficients": {"rows": 1, "cols": len(d), "data": d},
            "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
            "projection_matrix": {"rows": 3, "cols": 4, "data": p},
        },
    )
    opencv = folder / "camera_opencv.yaml"
    lines = ["%YAML:1.0", "---", *(f"{name}: {value}" for name, value in size.items())]
    lines += [f"fisheye_model: {int(fisheye)}"]
    for name, rows, columns, data in (
        ("camera_matrix", 3, 3, k),
        ("distortion_coefficients", 1, len(d), d),
    ):
        lines += [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}"]
        lines += ["   dt: d", f"   data: [ {', '.join(f'{value:.17g}' for value in data)} ]"]
    with atomic_write(opencv) as stream:
        stream.write(("\n".join(lines) + "\n").encode())
    return [ros, opencv]
