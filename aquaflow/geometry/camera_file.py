"""A camera's calibration as a file that :func:`aquaflow.geometry.camera.load_camera` reads."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from aquaflow.base.storage.atomic import write_yaml
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
