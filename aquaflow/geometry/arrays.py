"""Similarities, cameras, numbers as plain arrays and JSON: what a file without pickle holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError
from aquaflow.geometry.camera import CameraModel, camera_of_values
from aquaflow.geometry.similarity import Sim3

Array = npt.NDArray[Any]
Arrays = dict[str, Array]

SIM3 = 13
"""Numbers of a similarity: R row by row, t, scale."""
ROTATION_TOLERANCE = 1e-6
"""Largest difference of R^T R from the identity in a file."""


def of_sim3(poses: Sequence[Sim3]) -> npt.NDArray[np.float64]:
    """[N, 13]"""
    rows = [np.concatenate([T.R.ravel(), T.t, [T.scale]]) for T in poses]
    return np.array(rows, np.float64).reshape(-1, SIM3)


def to_sim3(
    row: Array,  # [13]
) -> Sim3:
    """The similarity in one row of :func:`of_sim3`."""
    return Sim3(row[:9].reshape(3, 3).copy(), row[9:12].copy(), float(row[12]))


def sim3_to_json(T: Sim3) -> dict[str, Any]:
    """``scale``, ``rotation`` and ``translation`` as plain values."""
    return {"scale": float(T.scale), "rotation": T.R.tolist(), "translation": T.t.tolist()}


def sim3_from_json(stated: Mapping[str, Any]) -> Sim3:
    """The similarity that :func:`sim3_to_json` made, or that a person wrote.

    Raises:
        DamagedError, KeyError, TypeError, ValueError: it is none.
    """
    R = np.asarray(stated["rotation"], np.float64)
    t = np.asarray(stated["translation"], np.float64)
    T = Sim3(R, t, float(stated["scale"]))
    if R.shape != (3, 3) or t.shape != (3,) or not T.is_finite():
        raise DamagedError("a transform is not finite")
    if np.abs(R.T @ R - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0.0:
        raise DamagedError("a transform's rotation is none")
    return T


def of_camera(camera: CameraModel) -> dict[str, Any]:
    """The camera as plain values for JSON."""
    return asdict(camera)


def to_camera(values: dict[str, Any]) -> CameraModel:
    """Raises KeyError, TypeError, ValueError where the values are no camera."""
    return camera_of_values(values)


class Cameras:
    """The few distinct cameras of many views, by number."""

    def __init__(self) -> None:
        self.known: list[CameraModel] = []

    def number(self, camera: CameraModel) -> int:
        """Its place in the list, where it is added if it is new."""
        if camera not in self.known:
            self.known.append(camera)
        return self.known.index(camera)

    def to_json(self) -> list[dict[str, Any]]:
        """All of them, as plain values."""
        return [of_camera(camera) for camera in self.known]


def add_prefix(
    prefix: str,
    arrays: Arrays,  # by name, of any shape
) -> Arrays:
    """The same arrays under ``prefix.name``."""
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def under(
    prefix: str,
    arrays: Mapping[str, Array],  # by name, of any shape
) -> Arrays:
    """What :func:`add_prefix` put there."""
    start = f"{prefix}."
    return {name[len(start) :]: array for name, array in arrays.items() if name.startswith(start)}
