"""A camera's calibration as a file that :func:`aquaflow.geometry.camera.load_camera` reads."""

from __future__ import annotations

from pathlib import Path

from aquaflow.geometry.camera import CameraModel
from aquaflow.storage.atomic import write_yaml


def save_camera(camera: CameraModel, path: Path) -> None:
    """Write ``camera`` to ``path``.

    Raises:
        InputError: the file cannot be written.
    """
    data = {
        "width": camera.width,
        "height": camera.height,
        "model": "pinhole",
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "distortion_model": camera.distortion_model,
        "distortion": list(camera.distortion),
        "port": camera.port.kind,
    }
    write_yaml(path, data)
