"""Which earlier keyframes may show the same place: an inverted file over the prior's descriptors.

Each descriptor of a keyframe goes to the nearest of some thousand words; what it differs by from
the word is kept as the signs of random projections, summed over the word's descriptors (aggregated
selective match kernel: Tolias, Avrithis, Jegou 2013). Two keyframes are similar by the words that
they share, each counted by how well the signs agree.

No vocabulary is shipped: the words are drawn, with a fixed seed, from a normal distribution with
the mean and covariance of the first keyframe's descriptors. Words taken from the descriptors
themselves would fit that keyframe too well, and a dive ends where it began.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from aquaflow.config import RetrievalConfig
from aquaflow.prior.contract import Encoding, Float
from aquaflow.tracking.keypoints import rooted

SEED = 0
DIMENSIONS = 32
"""Principal directions of the descriptors that words differ in; 64 separate worse (measured)."""
SIGNS = 64
"""Bits kept for each word of a keyframe: one machine word."""
SELECTIVITY = 3.0
"""Power of the agreement of two bit strings; from the paper."""
BLOCK_KEYFRAMES = 128
"""Keyframes sorted into lists together: large enough for few blocks, small enough to sort fast."""

AGREEMENT = np.maximum(1.0 - 2.0 * np.arange(SIGNS + 1) / SIGNS, 0.0) ** SELECTIVITY
"""[SIGNS + 1] what a shared word counts when so many signs differ; nothing below chance."""

Bits = npt.NDArray[np.uint64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Candidate:
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
        self._blocks: list[_Block] = []
        self._open: list[tuple[int, _Signature]] = []
        self._latest: _Signature | None = None
        self._consecutive: list[float] = []
        self._known: tuple[Encoding, _Signature] | None = None

    def add(self, number: int, encoding: Encoding) -> None:
        """Remember keyframe ``number``; one that shows nothing to recognise is left out."""
        signature = self._signature(encoding)
        if signature is None:
            return
        if self._latest is not None:
            self._consecutive.append(float(_similarities([signature], self._latest)[0]))
        self._latest = signature
        self._open.append((number, signature))
        if len(self._open) == BLOCK_KEYFRAMES:
            self._blocks.append(_Block(self._open, self._config.words))
            self._open = []

    def candidates(
        self, encoding: Encoding, exclude: Callable[[int], bool], count: int | None = None
    ) -> list[Candidate]:
        """At most ``count`` (default: the config's) plausible keyframes, most similar first."""
        if self._vocabulary is None:  # and no keyframe yet
            return []
        signature = self._signature(encoding)
        if signature is None:
            return []
        found = [block.similarities(signature) for block in self._blocks]
        found.append(_similarities([past for _, past in self._open], signature))
        numbers = [number for block in self._blocks for number in block.numbers]
        numbers += [number for number, _ in self._open]
        similarity = np.concatenate(found)
        best: list[Candidate] = []
        for i in np.argsort(-similarity, kind="stable"):
            wanted = self._config.candidates if count is None else count
            if len(best) == wanted or similarity[i] < self.plausible:
                break
            if not exclude(numbers[i]):
                best.append(Candidate(numbers[i], float(similarity[i])))
        return best

    @property
    def plausible(self) -> float:
        """The similarity that a candidate must have: a part of what neighbours on the path have."""
        usual = float(np.median(self._consecutive)) if self._consecutive else 0.0
        return max(self._config.min_similarity, self._config.neighbour_share * usual)

    def _signature(self, encoding: Encoding) -> _Signature | None:
        if self._known is not None and self._known[0] is encoding:
            return self._known[1]
        descriptors = rooted(encoding.keypoints.descriptors)
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
        self._offset = (self._words * self._words).sum(1)
        self._projection = rng.normal(size=(size, SIGNS)).astype(np.float32)

    def signature(
        self,
        descriptors: Float,  # [M, d]
    ) -> _Signature:
        x = (descriptors - self._mean) @ self._directions
        nearest = np.argmax(2.0 * (x @ self._words.T) - self._offset, axis=1)
        words, place = np.unique(nearest, return_inverse=True)
        rest = np.zeros((len(words), x.shape[1]), np.float32)
        np.add.at(rest, place, x - self._words[nearest])
        packed = np.packbits(rest @ self._projection > 0.0, axis=1)
        return _Signature(words.astype(np.int64), packed.view(np.uint64)[:, 0])


class _Block:
    """An inverted file over some keyframes: for each word, who has it and with which signs."""

    def __init__(self, members: list[tuple[int, _Signature]], words: int) -> None:
        self.numbers = [number for number, _ in members]
        self._sizes = np.array([len(signature.words) for _, signature in members])
        every = np.concatenate([signature.words for _, signature in members])
        owner = np.repeat(np.arange(len(members), dtype=np.int32), self._sizes)
        order = np.argsort(every, kind="stable")
        self._starts = np.searchsorted(every[order], np.arange(words + 1))
        self._owner = owner[order]
        self._signs = np.concatenate([signature.signs for _, signature in members])[order]

    def similarities(self, query: _Signature) -> npt.NDArray[np.float64]:
        """[members] similarity of every member to ``query``."""
        first = self._starts[query.words]
        count = self._starts[query.words + 1] - first
        before = np.cumsum(count) - count
        entry = np.repeat(first - before, count) + np.arange(int(count.sum()))
        differing = np.bitwise_count(self._signs[entry] ^ np.repeat(query.signs, count))
        votes = np.bincount(self._owner[entry], AGREEMENT[differing], len(self.numbers))
        return votes / np.sqrt(self._sizes * float(len(query.words)))


def _similarities(signatures: list[_Signature], query: _Signature) -> npt.NDArray[np.float64]:
    """[N] the same, one by one."""
    out = np.zeros(len(signatures))
    for i, signature in enumerate(signatures):
        _, mine, theirs = np.intersect1d(
            query.words, signature.words, assume_unique=True, return_indices=True
        )
        differing = np.bitwise_count(query.signs[mine] ^ signature.signs[theirs])
        size = np.sqrt(float(len(query.words)) * len(signature.words))
        out[i] = AGREEMENT[differing].sum() / size
    return out
