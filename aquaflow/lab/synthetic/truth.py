"""Reading back a synthetic dive: what is true about every picture.

The folder of a dive:

- ``images/000000.png``: the pictures, 8 bit RGB, linear radiance;
- ``clean/000000.png``: the same in full daylight without water, snow, vignette and noise (J), 8
  bit, linear;
- ``range/000000.npz``: ``range_m`` float32 [H, W] along the ray of each pixel's centre (0 where
  nothing is hit) and ``hit`` bool [H, W]; ``moving`` bool [H, W] where fish or an arm are seen, if
  any are;
- ``camera.yaml``, ``timestamps.txt`` (s, a line per picture), ``poses.tum`` (t_s tx ty tz qx qy qz
  qw, camera to world), ``medium.yaml`` (the water), ``telemetry.csv``, ``positions.csv`` (fixes for
  who wants the dive on the earth), ``synth.yaml`` (the config, the version, how the camera is
  mounted as a user believes it, and under ``truth`` the true mountings and constant errors of the
  instruments).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import AquaFlowError, InputError, reason_of
from aquaflow.base.errors.regular_file import read_mapping
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.lab.synthetic.config import SyntheticConfig
from aquaflow.lab.synthetic.water import Medium, load_medium

Array: TypeAlias = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """A dive's ground truth; pictures are read when asked for."""

    folder: Path
    config: SyntheticConfig
    camera: CameraModel
    medium: Medium
    timestamps_s: Array
    """[N]"""
    T_wc: Array
    """[N, 4, 4], camera to world, metres."""
    R_bc: Array
    """[3, 3], camera axes to the body's forward, right, down, in truth."""
    T_bc: Array
    """[4, 4], camera to body, metres, in truth."""
    T_bc_stated: Array
    """[4, 4], the same as a user believes it; without a mounting error it is the truth."""
    errors: dict[str, Any]
    """Section ``truth`` of synth.yaml by name; empty for dives of version 1."""

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def range_m(self, index: int) -> npt.NDArray[np.float32]:
        """[H, W] range along the ray of each pixel's centre; inf where nothing is hit."""
        found = self._ranges(index)
        return np.where(found["hit"], found["range_m"], np.float32(np.inf))

    def moving(self, index: int) -> npt.NDArray[np.bool_]:
        """[H, W] where something is seen that moves by itself: fish, an arm."""
        found = self._ranges(index)
        return np.asarray(found.get("moving", np.zeros(found["hit"].shape, bool)))

    def clean(self, index: int) -> npt.NDArray[np.float32]:
        """[H, W, 3] radiance without water, in [0, 1]."""
        return self._picture("clean", index)

    def image(self, index: int) -> npt.NDArray[np.float32]:
        """[H, W, 3] the picture as the camera stored it, in [0, 1]."""
        return self._picture("images", index)

    def points_w(self, index: int) -> Array:
        """[H, W, 3] what each pixel's centre sees, world frame; inf or nan where nothing is hit."""
        rays = self.camera.unproject(self.camera.pixel_centres())
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        T = self.T_wc[index]
        points = self.range_m(index)[..., None].astype(np.float64) * rays
        return np.asarray(points @ T[:3, :3].T + T[:3, 3])

    def _ranges(self, index: int) -> dict[str, npt.NDArray[Any]]:
        path = self.folder / "range" / f"{index:06d}.npz"
        try:
            with np.load(path) as data:
                found = dict(data)
            return {**found, "hit": found["hit"], "range_m": found["range_m"]}
        except (OSError, KeyError, ValueError) as error:
            raise InputError(
                f"cannot read the ranges {path}: {reason_of(error)}; write the dive again"
            ) from error

    def _picture(self, kind: str, index: int) -> npt.NDArray[np.float32]:
        import cv2

        path = self.folder / kind / f"{index:06d}.png"
        bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if bgr is None:
            raise InputError(f"cannot read the picture {path}; write the dive again")
        return np.asarray(bgr[..., ::-1], np.float32) / np.float32(255.0)


def read_truth(out: Path) -> Truth:
    """Read the dive that ``write_dive`` wrote to ``out``.

    Raises:
        InputError: a file of it is missing or damaged.
    """
    try:
        stated = read_mapping(out / "synth.yaml", "facts of the dive", "write the dive again")
        config = SyntheticConfig.model_validate(stated["config"])
        errors = dict(stated.get("truth", {}))
        T_bc_stated = _mounting(stated["mounting"])
        T_bc = _mounting(errors) if errors else T_bc_stated
        rows = np.loadtxt(out / "poses.tum", ndmin=2).reshape(-1, 8)
        times = np.loadtxt(out / "timestamps.txt", ndmin=1)
    except (AquaFlowError, OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{out} is not a complete synthetic dive ({reason_of(error)}); write it again with "
            "aquaflow lab synth"
        ) from error
    T_wc = np.tile(np.eye(4), (len(rows), 1, 1))
    T_wc[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    T_wc[:, :3, 3] = rows[:, 1:4]
    camera = load_camera(out / "camera.yaml")
    medium = load_medium(out / "medium.yaml")
    return Truth(out, config, camera, medium, times, T_wc, T_bc[:3, :3], T_bc, T_bc_stated, errors)


def _mounting(section: dict[str, Any]) -> Array:
    """[4, 4] camera to body of a section of synth.yaml."""
    T = np.eye(4)
    T[:3, :3] = np.array(section["R_body_camera"], np.float64).reshape(3, 3)
    T[:3, 3] = section["t_body_camera_m"]
    return T
