"""A synthetic dive as a camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from aquaflow.config.telemetry import MountingConfig
from aquaflow.fusion.start import AXES
from aquaflow.synthetic import read_truth
from sim_drivers.images import SUBFOLDER, ImageFolder

MARK = "synth.yaml"
"""Only ``aquaflow synth`` writes this file."""


class SyntheticDive(ImageFolder):
    """A folder that ``aquaflow synth`` wrote: pictures, calibration and ground truth."""

    specificity = 2

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return (path / MARK).is_file() and (path / SUBFOLDER).is_dir()

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> SyntheticDive:
        return cls(path, fps)

    @property
    def mounting(self) -> MountingConfig:
        """Of the camera, as the dive states it.

        Raises:
            InputError: a file of the dive is missing or damaged.
        """
        T_bc = read_truth(self.folder).T_bc_stated
        yaw, pitch, roll = Rotation.from_matrix(T_bc[:3, :3] @ AXES.T).as_euler("ZYX", degrees=True)
        x, y, z = np.asarray(T_bc[:3, 3], np.float64).tolist()
        return MountingConfig(position_m=(x, y, z), roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw)
