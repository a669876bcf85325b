"""Relocalisation and loop detection: retrieval of similar keyframes, then verification."""

from __future__ import annotations

import threading
from collections.abc import Container
from dataclasses import dataclass

from aquaflow.base.errors import InputError
from aquaflow.config import TrackingConfig
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
    """Retrieval of similar keyframes, then geometric verification of the plausible ones; for any
    thread."""

    def __init__(self, keyframes: KeyframeStore, config: TrackingConfig) -> None:
        self._keyframes, self._config = keyframes, config
        self._retrieval, self._lock = Retrieval(config.retrieval), threading.Lock()

    def add(self, number: int, encoding: Encoding) -> None:
        """Index keyframe ``number``, so that its place can be found again."""
        with self._lock:
            self._retrieval.add(number, encoding)

    def of_frame(self, encoding: Encoding, camera: CameraModel) -> Relocalised | None:
        """Pose of a lost frame, from the first keyframe, most similar first, that verifies."""
        for number in self._similar(encoding, ()):
            found = self._verify(number, encoding, camera)
            if found is not None:
                return found
        return None

    def of_keyframe(
        self, encoding: Encoding, pointmap: Pointmap, besides: Container[int]
    ) -> list[Relocalised]:
        """Keyframes, but for some, that show the same place as the one with this ``encoding`` and
        ``pointmap``, with relative scale."""
        numbers = self._similar(encoding, besides)
        found = [self._verify(n, encoding, encoding.camera, pointmap) for n in numbers]
        return [place for place in found if place is not None]

    def _similar(self, encoding: Encoding, besides: Container[int]) -> list[int]:
        with self._lock:
            found = self._retrieval.candidates(encoding, besides.__contains__)
        return [candidate.number for candidate in found]

    def _verify(
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
