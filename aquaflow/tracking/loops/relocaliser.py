"""Relocalisation and loop detection: retrieval of similar keyframes, then verification."""

from __future__ import annotations

import threading
from collections.abc import Callable, Container
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.config import RetrievalConfig, TrackingConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.prior.contract import Encoding, Float, HasKeypoints
from aquaflow.tracking.loops.verification import take_root, verify
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


# --------------------------------------------------------------------------------------------------
# Which earlier keyframes may show the same place: an inverted file over the prior's descriptors.
#
# Each descriptor of a keyframe goes to the nearest of some thousand words; what it differs by from
# the word is kept as the signs of random projections, summed over the word's descriptors
# (aggregated selective match kernel: Tolias, Avrithis, Jegou 2013). Two keyframes are similar by
# the words that they share, each counted by how well the signs agree.
#
# No vocabulary is shipped: the words are drawn, with a fixed seed, from a normal distribution with
# the mean and covariance of the first keyframe's descriptors. Words taken from the descriptors
# themselves would fit that keyframe too well, and a dive ends where it began.

SEED = 0
"""The same dive gives the same words."""
DIMENSIONS = 32
"""Principal directions of the descriptors that words differ in; 64 separate worse (measured)."""
SIGNS = 64
"""Bits kept for each word of a keyframe: one machine word."""
SELECTIVITY = 3.0
"""Power of the agreement of two bit strings; from the paper."""
LEAST_AGREEMENT = 0.25
"""Agreement below which a shared word counts nothing; the paper's tau. Three quarters of the words
that 10^4 synthetic keyframes share stay below: a query takes 0.6 of the time (measured)."""
SHORTEST_LIST = 8
"""Keyframes that a word's list has room for at first; it grows by half."""
MATCHED_TOGETHER = 256
"""Descriptors whose distances to all words fit into a core's cache: a fifth faster (measured)."""

MOST_DIFFERING = int(SIGNS * (1.0 - LEAST_AGREEMENT) / 2.0)
"""Signs that may differ in a shared word that counts."""
AGREEMENT = (1.0 - 2.0 * np.arange(MOST_DIFFERING + 1) / SIGNS) ** SELECTIVITY
"""[MOST_DIFFERING + 1] what a shared word counts when so many signs differ."""

Bits = npt.NDArray[np.uint64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class SimilarKeyframe:
    """A keyframe that may show the same place."""

    number: int
    similarity: float
    """0 to 1: 1 for the same picture, about 0.01 by chance."""


@dataclass(frozen=True)
class _Signature:
    """The words of one keyframe and the signs of what it differs by from them."""

    words: Index
    """[w] sorted, no repetition."""
    signs: Bits
    """[w]"""


class Retrieval:
    """Grows with the dive; the same keyframes in the same order give the same candidates."""

    def __init__(self, config: RetrievalConfig) -> None:
        self._config = config
        self._vocabulary: _Vocabulary | None = None
        self._numbers: list[int] = []
        self._file = _InvertedFile(config.words)
        self._latest: _Signature | None = None
        self._consecutive: list[float] = []
        self._known: tuple[HasKeypoints, _Signature] | None = None

    def add(self, number: int, encoding: HasKeypoints) -> None:
        """Remember keyframe ``number``; one that shows nothing to recognise is left out."""
        signature = self._signature(encoding)
        if signature is None:
            return
        if self._latest is not None:
            self._consecutive.append(_similarity(signature, self._latest))
        self._latest = signature
        self._numbers.append(number)
        self._file.add(signature)

    def candidates(
        self,
        encoding: HasKeypoints,
        exclude: Callable[[int], bool],
        count: int | None = None,
        least: float | None = None,
    ) -> list[SimilarKeyframe]:
        """At most ``count`` (default: the config's) plausible keyframes, most similar first;
        ``least``: similarity of those, where it shall not be a share of that of neighbours."""
        if not self._numbers:
            return []
        signature = self._signature(encoding)
        if signature is None:
            return []
        similarity = self._file.similarities(signature)
        plausible = np.flatnonzero(similarity >= (self.plausible if least is None else least))
        wanted = self._config.candidates if count is None else count
        best: list[SimilarKeyframe] = []
        for i in plausible[np.argsort(-similarity[plausible], kind="stable")]:
            if len(best) == wanted:
                break
            if not exclude(self._numbers[i]):
                best.append(SimilarKeyframe(self._numbers[i], float(similarity[i])))
        return best

    @property
    def plausible(self) -> float:
        """The similarity that a candidate must have: a part of what neighbours on the path have."""
        usual = float(np.median(self._consecutive)) if self._consecutive else 0.0
        return max(self._config.min_similarity, self._config.neighbour_share * usual)

    def _signature(self, encoding: HasKeypoints) -> _Signature | None:
        if self._known is not None and self._known[0] is encoding:
            return self._known[1]
        descriptors = take_root(encoding.keypoints.descriptors)
        if len(descriptors) < self._config.min_descriptors:
            return None
        if self._vocabulary is None:
            self._vocabulary = _Vocabulary(descriptors, self._config.words)
        signature = self._vocabulary.signature(descriptors)
        self._known = (encoding, signature)
        return signature


class _Vocabulary:
    """Words and projections, fixed once drawn."""

    def __init__(
        self,
        descriptors: Float,  # [M, d] of the first keyframe
        words: int,
    ) -> None:
        rng = np.random.default_rng(SEED)
        self._mean = descriptors.mean(0)
        variance, directions = np.linalg.eigh(np.cov(descriptors.T.astype(np.float64)))
        size = min(DIMENSIONS, len(variance))
        self._directions = directions[:, ::-1][:, :size].astype(np.float32)
        spread = np.sqrt(np.maximum(variance[::-1][:size], 0.0))
        self._words = (rng.normal(size=(words, size)) * spread).astype(np.float32)
        self._twice = 2.0 * self._words.T
        self._offset = (self._words * self._words).sum(1)
        self._projection = rng.normal(size=(size, SIGNS)).astype(np.float32)

    def signature(
        self,
        descriptors: Float,  # [M, d]
    ) -> _Signature:
        x = (descriptors - self._mean) @ self._directions
        starts = range(0, len(x), MATCHED_TOGETHER)
        nearest = np.concatenate([self._nearest(x[i : i + MATCHED_TOGETHER]) for i in starts])
        words, place = np.unique(nearest, return_inverse=True)
        rest = np.zeros((len(words), x.shape[1]), np.float32)
        np.add.at(rest, place, x - self._words[nearest])
        packed = np.packbits(rest @ self._projection > 0.0, axis=1)
        return _Signature(words.astype(np.int64), packed.view(np.uint64)[:, 0])

    def _nearest(
        self,
        x: Float,  # [m, size]
    ) -> Index:
        """[m] the word next to each: |x - word|^2 = |x|^2 - 2 x . word + |word|^2."""
        nearness = x @ self._twice
        nearness -= self._offset
        return np.asarray(np.argmax(nearness, axis=1), dtype=np.int64)


class _InvertedFile:
    """For each word, which keyframes have it and with which signs."""

    def __init__(self, words: int) -> None:
        self._sizes: list[int] = []
        self._lengths = [0] * words
        self._owners = [np.empty(SHORTEST_LIST, np.int32) for _ in range(words)]
        self._signs = [np.empty(SHORTEST_LIST, np.uint64) for _ in range(words)]

    def __len__(self) -> int:
        return len(self._sizes)

    def add(self, signature: _Signature) -> None:
        """One keyframe more."""
        owner = len(self._sizes)
        self._sizes.append(len(signature.words))
        for word, signs in zip(signature.words.tolist(), signature.signs, strict=True):
            end = self._lengths[word]
            if end == len(self._owners[word]):
                self._owners[word] = np.resize(self._owners[word], end + end // 2)
                self._signs[word] = np.resize(self._signs[word], end + end // 2)
            self._owners[word][end], self._signs[word][end] = owner, signs
            self._lengths[word] = end + 1

    def similarities(self, query: _Signature) -> npt.NDArray[np.float64]:
        """[keyframes] similarity of every keyframe to ``query``."""
        words = query.words.tolist()
        ends = np.cumsum([self._lengths[word] for word in words]).tolist()
        differing = np.empty(ends[-1], np.uint8)
        differs, start = np.empty(len(self), np.uint64), 0  # of one word: stays in the cache
        for word, signs, end in zip(words, query.signs, ends, strict=True):
            count = end - start
            np.bitwise_xor(self._signs[word][:count], signs, out=differs[:count])
            np.bitwise_count(differs[:count], out=differing[start:end])
            start = end
        owners = np.concatenate([self._owners[word][: self._lengths[word]] for word in words])
        agreeing = np.flatnonzero(differing <= MOST_DIFFERING)
        votes = np.bincount(owners[agreeing], AGREEMENT[differing[agreeing]], len(self))
        return votes / np.sqrt(np.array(self._sizes) * float(len(words)))


def _similarity(a: _Signature, b: _Signature) -> float:
    """Of two signatures: 0 to 1."""
    _, in_a, in_b = np.intersect1d(a.words, b.words, assume_unique=True, return_indices=True)
    differing = np.bitwise_count(a.signs[in_a] ^ b.signs[in_b])
    votes = AGREEMENT[differing[differing <= MOST_DIFFERING]].sum()
    return float(votes / np.sqrt(float(len(a.words)) * len(b.words)))
