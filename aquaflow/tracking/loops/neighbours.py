"""Keyframes that overlap with a frame, by the poses of the keyframe graph alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config import TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe
from aquaflow.tracking.pose.visibility import is_expected, sample

Array = npt.NDArray[np.float64]

SKETCH_POINTS = 64
"""Points kept of a keyframe: an overlap is known to about a twentieth, for 1.5 kB."""
NEAREST = 32
"""Nearest keyframes, by the distance of their centres, whose overlap is computed."""
ROLL_RAD = np.radians(20.0)
"""Turn about the viewing direction beyond which flow hardly matches two pictures: on synthetic
dives 0.63 of the picture up to 10 degrees, 0.45 at 20, and nothing from 30 on."""
CROWD_OVERLAP = 0.6
"""Predicted share in view from which a keyframe counts as one of the place."""


@dataclass(frozen=True)
class Neighbour:
    """A keyframe of the same place, by its pose."""

    keyframe: Keyframe
    T_fk: Sim3
    """Keyframe to frame, by the graph's poses."""
    overlap: float
    """Share of the keyframe's points that the frame should show."""

    @property
    def roll_rad(self) -> float:
        """Turn of the picture about the viewing direction."""
        R = self.T_fk.R
        return abs(float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])))

    @property
    def likeness(self) -> float:
        """Overlap, less where the picture is turned: most first is most worth a try."""
        return self.overlap * float(np.exp(-0.5 * (self.roll_rad / ROLL_RAD) ** 2))


class Neighbours:
    """A few points of every keyframe that was left; poses are read when they are needed, because
    the graph moves them."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._sketches: dict[int, tuple[Keyframe, Array]] = {}
        self._aside: set[int] = set()

    def add(self, keyframe: Keyframe) -> None:
        """Store the points of ``keyframe`` as it is left for the first time; they are not updated,
        so that they say later what its depths were."""
        if keyframe.number not in self._sketches and keyframe.number not in self._aside:
            points = sketch(keyframe, self._config)
            if len(points):
                self._sketches[keyframe.number] = (keyframe, points)

    def set_aside(self, keyframe: Keyframe) -> None:
        """Return to ``keyframe`` no more, and ask it about no other: its scale is wrong."""
        self._sketches.pop(keyframe.number, None)
        self._aside.add(keyframe.number)

    def points(self, keyframe: Keyframe) -> Array | None:
        """[M, 3] in its camera frame; None if it has not been left yet."""
        held = self._sketches.get(keyframe.number)
        return None if held is None else held[1]

    def around(
        self, T_wc: Sim3, camera: CameraModel, sub_map: int, besides: Keyframe
    ) -> list[Neighbour]:
        """Keyframes of ``sub_map``, but for one, of which a frame at ``T_wc`` should show
        ``crowd_overlap``, not turned too far to match; the most alike first."""
        here = [
            sketch for sketch in self._sketches.values()
            if sketch[0].sub_map == sub_map and sketch[0] is not besides
        ]  # fmt: skip
        if not here:
            return []
        centres = np.array([keyframe.T_wc.t for keyframe, _ in here])
        distance = np.linalg.norm(centres - T_wc.t, axis=1)
        T_fw, found = T_wc.inverse(), []
        for i in np.argsort(distance, kind="stable")[:NEAREST]:
            keyframe, points = here[i]
            T_fk = T_fw @ keyframe.T_wc
            neighbour = Neighbour(keyframe, T_fk, float(is_expected(points, T_fk, camera).mean()))
            if neighbour.overlap >= CROWD_OVERLAP and neighbour.roll_rad < ROLL_RAD:
                found.append(neighbour)
        return sorted(found, key=lambda neighbour: -neighbour.likeness)


def sketch(keyframe: Keyframe, config: TrackingConfig) -> Array:
    """[M, 3] some points of a keyframe, in its camera frame."""
    known = keyframe.pointmap.is_known(config.known_sigma)
    return sample(keyframe.pointmap, known, SKETCH_POINTS)[2]
