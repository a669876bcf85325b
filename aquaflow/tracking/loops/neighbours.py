"""Keyframes that overlap with a frame, by the poses of the keyframe graph alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe
from aquaflow.tracking.pose.visibility import expected, sampled

Array = npt.NDArray[np.float64]

SKETCH_POINTS = 64
"""Points kept of a keyframe: an overlap is known to about a twentieth, for 1.5 kB."""
NEAREST = 32
"""Nearest keyframes, by the distance of their centres, whose overlap is computed."""


class Neighbours:
    """A few points of every keyframe that was left; poses are read when they are needed, because
    the graph moves them."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._sketches: dict[int, tuple[Keyframe, Array]] = {}

    def add(self, keyframe: Keyframe) -> None:
        """Store or update the points of ``keyframe``."""
        known = keyframe.pointmap.known(self._config.known_sigma)
        points = sampled(keyframe.pointmap, known, SKETCH_POINTS)[2]
        if len(points):
            self._sketches[keyframe.number] = (keyframe, points)

    def best(self, T_wc: Sim3, camera: CameraModel, sub_map: int) -> list[tuple[Keyframe, Sim3]]:
        """Keyframes of ``sub_map`` of which a frame at ``T_wc`` should show ``return_overlap``,
        with their T_fk, most overlap first."""
        here = [s for s in self._sketches.values() if s[0].sub_map == sub_map]
        if not here:
            return []
        centres = np.array([keyframe.T_wc.t for keyframe, _ in here])
        distance = np.linalg.norm(centres - T_wc.t, axis=1)
        T_fw, found = T_wc.inverse(), []
        for i in np.argsort(distance, kind="stable")[:NEAREST]:
            keyframe, points = here[i]
            T_fk = T_fw @ keyframe.T_wc
            overlap = float(expected(points, T_fk, camera).mean())
            if overlap >= self._config.return_overlap:
                found.append((overlap, keyframe, T_fk))
        found.sort(key=lambda item: -item[0])
        return [(keyframe, T_fk) for _, keyframe, T_fk in found]
