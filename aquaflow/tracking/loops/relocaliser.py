"""Relocalisation and loop detection: retrieval of similar keyframes, then verification."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from aquaflow.config import TrackingConfig
from aquaflow.errors import InputError
from aquaflow.geometry.camera import CameraModel
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.prior.contract import Encoding
from aquaflow.tracking.loops.retrieval import Retrieval
from aquaflow.tracking.loops.verification import verify
from aquaflow.tracking.pose.solver import PoseEstimate


@dataclass(frozen=True)
class Relocalised:
    """A keyframe that shows the same place, verified by geometry."""

    keyframe: Keyframe
    estimate: PoseEstimate
    """``estimate.T`` is T_fk: keyframe to frame."""


class Places:
    """Retrieval of similar keyframes, then geometric verification of the plausible ones."""

    def __init__(self, keyframes: KeyframeStore, config: TrackingConfig) -> None:
        self._keyframes, self._config = keyframes, config
        self._retrieval = Retrieval(config.retrieval)

    def add(self, keyframe: Keyframe) -> None:
        """Index ``keyframe``, so that its place can be found again."""
        self._retrieval.add(keyframe.number, keyframe.encoding)

    def of_frame(self, encoding: Encoding, camera: CameraModel) -> Relocalised | None:
        """Pose of a lost frame, from the first keyframe, most similar first, that verifies."""
        for candidate in self._retrieval.candidates(encoding, lambda _: False):
            found = self._verified(candidate.number, encoding, camera)
            if found is not None:
                return found
        return None

    def of_keyframe(self, keyframe: Keyframe, exclude: Callable[[int], bool]) -> list[Relocalised]:
        """Earlier keyframes that show the same place as ``keyframe``, with relative scale."""
        encoding, pointmap = keyframe.encoding, keyframe.pointmap
        numbers = [found.number for found in self._retrieval.candidates(encoding, exclude)]
        found = [self._verified(n, encoding, encoding.camera, pointmap) for n in numbers]
        return [place for place in found if place is not None]

    def _verified(
        self,
        number: int,
        encoding: Encoding,
        camera: CameraModel,
        pointmap: Pointmap | None = None,
    ) -> Relocalised | None:
        past = self._keyframes[number]
        try:
            proof = verify(past, encoding, camera, self._config.verification, pointmap)
        except InputError:
            return None  # a keyframe that cannot be read back is skipped
        return None if proof is None else Relocalised(past, proof.estimate)
