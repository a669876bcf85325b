"""Is this a place of the base? Retrieval among its keyframes, then the proof by geometry.

Nothing of the new dive enters the index, and nothing of the base is tracked against: flow between
pictures of two days, in other light and water, would not hold. Keypoints do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from aquaflow.base.errors import InputError
from aquaflow.config import TrackingConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.keyframes.place import Place, depths_at
from aquaflow.prior.contract import Encoding
from aquaflow.tracking.base.base import Base
from aquaflow.tracking.loops.retrieval import Retrieval
from aquaflow.tracking.loops.verification import Verified, verify_keypoints

CANDIDATES = 5
"""Keyframes of the base that one picture is compared with at most; the first that proves to show
it ends the search."""
LEAST_SIMILARITY = 0.01
"""Of a candidate: what chance gives. Other light and water cost most of the similarity that
neighbours of one dive have (0.02 to 0.08 are left), and the proof refuses what is elsewhere."""
KEPT = 32
"""Keyframes of the base whose keypoints stay in memory: 1.2 MB each at 2000 keypoints."""


@dataclass(frozen=True)
class Recognised:
    """A picture of this dive at a keyframe of the base."""

    place: Place
    proof: Verified
    """``proof.estimate.T`` is T_kb, from the base's keyframe to this dive's, with scale."""

    @property
    def T_sk(self) -> Sim3:
        """This dive's keyframe in the world of the base's sub-map."""
        return self.place.T_mc @ self.proof.estimate.T.inverse()


class KnownPlaces:
    """The base's keyframes, to be asked from one thread."""

    def __init__(self, base: Base, config: TrackingConfig) -> None:
        """A keyframe that cannot be read is left out."""
        self._config = config.verification
        self._retrieval = Retrieval(config.retrieval)
        self._places: list[Place] = []
        self.damaged = 0
        """Keyframes of the base that could not be read."""
        self._keypoints = lru_cache(KEPT)(base.keypoints)
        for place in base.places:
            try:
                self._retrieval.add(len(self._places), base.keypoints(place.number))
            except InputError:
                self.damaged += 1
            else:
                self._places.append(place)

    def of(self, encoding: Encoding, pointmap: Pointmap) -> Recognised | None:
        """The first keyframe of the base, most similar first, that proves to show this place."""
        found = self._retrieval.candidates(
            encoding, lambda _: False, CANDIDATES, least=LEAST_SIMILARITY
        )
        for candidate in found:
            place = self._places[candidate.number]
            try:
                past = self._keypoints(place.number)
            except InputError:
                continue  # damaged since
            own = depths_at(encoding.keypoints, pointmap)
            proof = verify_keypoints(past, own.keypoints, own.camera, self._config, own)
            if proof is not None:
                return Recognised(place, proof)
        return None
