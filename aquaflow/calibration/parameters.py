"""What a calibration estimates, as a vector: the lens, or the place of a flat port before it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.port import FlatPort

Array = npt.NDArray[np.float64]

LENS = {
    "radtan": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
"""Numbers of a lens by its distortion model. A third radial term of radtan is not told from the
other two by a board that fills the picture, and goes wild where it does not."""
PORT = ("distance_m", "normal_x", "normal_y")
"""Of a flat port: its thickness and its indexes are known better than pictures show them."""


@dataclass(frozen=True)
class CameraUnknowns:
    """Which numbers of a camera are open."""

    start: CameraModel
    port: bool = False
    """The flat port's place, with a lens that is known; else the lens, with what port there is."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the numbers, in their order."""
        return PORT if self.port else LENS[self.start.distortion_model]

    @property
    def steps(self) -> Array:
        """[P] over which numbers are varied for a derivative: a few thousandths of a pixel."""
        if self.port:
            return np.array([1e-5, 1e-5, 1e-5])
        return np.array([1e-2, 1e-2, 1e-2, 1e-2, 1e-5, 1e-5, 1e-5, 1e-5])

    def values(self) -> Array:
        """[P] of the start."""
        if self.port:
            port = self.start.port
            assert isinstance(port, FlatPort)
            return np.array([port.distance_m, *port.normal[:2]])
        camera = self.start
        return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients[:4]])

    def camera(
        self,
        values: Array,  # [P]
    ) -> CameraModel:
        """The camera that has these numbers."""
        if self.port:
            port = self.start.port
            assert isinstance(port, FlatPort)
            distance, x, y = values.tolist()
            normal = (x, y, float(np.sqrt(max(1.0 - x * x - y * y, 0.0))))
            return replace(self.start, port=replace(port, distance_m=distance, normal=normal))
        fx, fy, cx, cy, *distortion = values.tolist()
        return replace(self.start, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))
