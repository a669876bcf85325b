"""Relocalisation and loops: similar keyframes are retrieved, then verified; neighbours by pose."""

from __future__ import annotations

import threading
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import InputError
from aquaflow.config import RetrievalConfig, TrackingConfig, VerificationConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Keyframe, KeyframeStore, Pointmap
from aquaflow.keyframes.place import KeypointDepths, depths_at
from aquaflow.prior.contract import Encoding, Float, HasKeypoints, Keypoints
from aquaflow.tracking.pose.matcher import is_expected, pose_from_scratch, sample
from aquaflow.tracking.pose.solver import PoseEstimate, PoseProblem, solve_pose


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
class Signature:
    """The words of one keyframe and the signs of what it differs by from them."""

    words: Index
    """[w] sorted, no repetition."""
    signs: Bits
    """[w]"""


class Retrieval:
    """Grows with the dive; the same keyframes in the same order give the same candidates."""

    def __init__(self, config: RetrievalConfig) -> None:
        self._config = config
        self._vocabulary: Vocabulary | None = None
        self._numbers: list[int] = []
        self._file = InvertedFile(config.words)
        self._latest: Signature | None = None
        self._consecutive: list[float] = []
        self._known: tuple[HasKeypoints, Signature] | None = None

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

    def _signature(self, encoding: HasKeypoints) -> Signature | None:
        if self._known is not None and self._known[0] is encoding:
            return self._known[1]
        descriptors = take_root(encoding.keypoints.descriptors)
        if len(descriptors) < self._config.min_descriptors:
            return None
        if self._vocabulary is None:
            self._vocabulary = Vocabulary.drawn(descriptors, self._config.words)
        signature = self._vocabulary.signature(descriptors)
        self._known = (encoding, signature)
        return signature


@dataclass(frozen=True)
class Vocabulary:
    """Words and projections, fixed once drawn."""

    mean: Float
    """[d] of descriptors."""
    directions: Float
    """[d, size] in which descriptors differ most."""
    words: Float
    """[words, size] along them."""
    projection: Float
    """[size, SIGNS]"""

    @staticmethod
    def drawn(
        descriptors: Float,  # [M, d] of the first keyframe
        words: int,
    ) -> Vocabulary:
        """Words as such descriptors lie."""
        rng = np.random.default_rng(SEED)
        variance, directions = np.linalg.eigh(np.cov(descriptors.T.astype(np.float64)))
        size = min(DIMENSIONS, len(variance))
        spread = np.sqrt(np.maximum(variance[::-1][:size], 0.0))
        return Vocabulary(
            descriptors.mean(0),
            directions[:, ::-1][:, :size].astype(np.float32),
            (rng.normal(size=(words, size)) * spread).astype(np.float32),
            rng.normal(size=(size, SIGNS)).astype(np.float32),
        )

    @cached_property
    def _twice(self) -> Float:
        return np.asarray(2.0 * self.words.T, np.float32)

    @cached_property
    def _offset(self) -> Float:
        return np.asarray((self.words * self.words).sum(1), np.float32)

    def signature(
        self,
        descriptors: Float,  # [M, d]
    ) -> Signature:
        """The words of descriptors, and the signs of what they differ by from them."""
        x: Float = np.asarray((descriptors - self.mean) @ self.directions, np.float32)
        starts = range(0, len(x), MATCHED_TOGETHER)
        nearest = np.concatenate([self._nearest(x[i : i + MATCHED_TOGETHER]) for i in starts])
        words, place = np.unique(nearest, return_inverse=True)
        rest = np.zeros((len(words), x.shape[1]), np.float32)
        np.add.at(rest, place, x - self.words[nearest])
        packed = np.packbits(rest @ self.projection > 0.0, axis=1)
        return Signature(words.astype(np.int64), packed.view(np.uint64)[:, 0])

    def _nearest(
        self,
        x: Float,  # [m, size]
    ) -> Index:
        """[m] the word next to each: |x - word|^2 = |x|^2 - 2 x . word + |word|^2."""
        nearness = x @ self._twice
        nearness -= self._offset
        return np.asarray(np.argmax(nearness, axis=1), dtype=np.int64)


class InvertedFile:
    """For each word, which keyframes have it and with which signs."""

    def __init__(self, words: int) -> None:
        self._sizes: list[int] = []
        self._lengths = [0] * words
        self._owners = [np.empty(SHORTEST_LIST, np.int32) for _ in range(words)]
        self._signs = [np.empty(SHORTEST_LIST, np.uint64) for _ in range(words)]

    @classmethod
    def of(cls, signatures: Sequence[Signature], words: int) -> InvertedFile:
        """As after adding the signatures in turn."""
        file = cls(words)
        file._sizes = [len(each.words) for each in signatures]
        if not signatures:
            return file
        found = np.concatenate([each.words for each in signatures])
        order = np.argsort(found, kind="stable")
        signs = np.concatenate([each.signs for each in signatures])[order]
        owners = np.repeat(np.arange(len(signatures), dtype=np.int32), file._sizes)[order]
        starts = np.searchsorted(found[order], np.arange(words + 1)).tolist()
        for word, (start, end) in enumerate(pairwise(starts)):
            if end > start:
                file._owners[word], file._signs[word] = owners[start:end], signs[start:end]
                file._lengths[word] = end - start
        return file

    def __len__(self) -> int:
        return len(self._sizes)

    def add(self, signature: Signature) -> None:
        """One keyframe more."""
        owner = len(self._sizes)
        self._sizes.append(len(signature.words))
        for word, signs in zip(signature.words.tolist(), signature.signs, strict=True):
            end = self._lengths[word]
            if end == len(self._owners[word]):
                self._owners[word] = np.resize(self._owners[word], end + end // 2 + 1)
                self._signs[word] = np.resize(self._signs[word], end + end // 2 + 1)
            self._owners[word][end], self._signs[word][end] = owner, signs
            self._lengths[word] = end + 1

    def similarities(self, query: Signature) -> npt.NDArray[np.float64]:
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


def _similarity(a: Signature, b: Signature) -> float:
    """Of two signatures: 0 to 1."""
    _, in_a, in_b = np.intersect1d(a.words, b.words, assume_unique=True, return_indices=True)
    differing = np.bitwise_count(a.signs[in_a] ^ b.signs[in_b])
    votes = AGREEMENT[differing[differing <= MOST_DIFFERING]].sum()
    return float(votes / np.sqrt(float(len(a.words)) * len(b.words)))


# --------------------------------------------------------------------------------------------------
# Is this the same place? A pose from keypoints alone, and whether chance could have made it.
#
# Dense flow finds a tenth of a picture in any other picture, and nothing in the same one turned
# round. Keypoints do neither: between pictures of different places some ten descriptors agree, and
# their pixels agree on no pose.

Array = npt.NDArray[np.float64]

GRID = (8, 6)
"""Cells of the picture, across and down, in which inliers are counted as spread."""


@dataclass(frozen=True)
class Verified:
    """A place found again: the pose of the frame at the keyframe, and what speaks for it."""

    estimate: PoseEstimate
    """``estimate.T`` is T_fk: keyframe to frame. With the frame's own pointmap its scale is free,
    and the covariance has the seventh row for it."""
    inliers: int
    """Keypoints that agree on the pose."""
    matched: int
    """Keypoints whose descriptors agree and whose depth the keyframe knows."""
    cells: int
    """Cells of the frame's picture, of 48, that hold an inlier."""


def verify(
    keyframe: Keyframe,
    encoding: Encoding,
    camera: CameraModel,
    config: VerificationConfig,
    pointmap: Pointmap | None = None,
) -> Verified | None:
    """The frame's pose at the keyframe, or None where the keypoints do not prove one.

    ``pointmap`` is the frame's own, where it has one: then the two pointmaps' scales are compared
    too, and a pair whose scales are not known to ``max_scale_sigma`` is no proof.
    """
    past = depths_at(keyframe.encoding.keypoints, keyframe.pointmap)
    own = None if pointmap is None else depths_at(encoding.keypoints, pointmap)
    return verify_keypoints(past, encoding.keypoints, camera, config, own)


def verify_keypoints(
    past: KeypointDepths,
    keypoints: Keypoints,
    camera: CameraModel,
    config: VerificationConfig,
    own: KeypointDepths | None = None,
) -> Verified | None:
    """As :func:`verify`, of keypoints alone: ``own`` are the frame's ``keypoints`` with depths."""
    mine, theirs = match_keypoints(past.keypoints, keypoints)
    kept = past.is_known(config.known_sigma)[mine]
    mine, theirs = mine[kept], theirs[kept]
    if len(mine) < config.min_inliers:
        return None
    pixels = keypoints.pixels[theirs].astype(np.float64)
    problem = PoseProblem(
        past.points()[mine], past.variance[mine], pixels, np.ones(len(mine)), camera,
        config.sigma_px,
    )  # fmt: skip
    initial = pose_from_scratch(problem)
    estimate = None if initial is None else solve_pose(problem, initial)
    if estimate is None:
        return None
    error = np.linalg.norm(camera.project(estimate.T.apply(problem.points)) - pixels, axis=1)
    inlier = error < config.inlier_px
    cells = _occupied_cells(pixels[inlier], camera)
    enough = inlier.sum() >= config.min_inliers and inlier.mean() >= config.min_inlier_share
    if not enough or cells < config.min_cells:
        return None
    if own is not None:
        estimate = _with_scale(past, own, (mine[inlier], theirs[inlier]), estimate, config)
        if estimate is None:
            return None
    return Verified(estimate, int(inlier.sum()), len(pixels), cells)


def _with_scale(
    past: KeypointDepths,
    own: KeypointDepths,
    inliers: tuple[Index, Index],  # keypoints of past and own, [M] each
    estimate: PoseEstimate,
    config: VerificationConfig,
) -> PoseEstimate | None:
    """The similarity between the two pointmaps; None where its scale stays unknown."""
    mine, theirs = inliers
    known = own.is_known(config.known_sigma)[theirs]
    if known.sum() < config.min_inliers:
        return None
    points = past.points()[mine]
    own_points = np.where(known[:, None], own.points()[theirs], np.nan)
    problem = PoseProblem(
        points,
        past.variance[mine],
        own.keypoints.pixels[theirs].astype(np.float64),
        np.ones(len(mine)),
        own.camera,
        config.sigma_px,
        frame_points=own_points,
        frame_rho_variance=np.where(known, own.variance[theirs], np.nan),
    )
    # Where the frame's pointmap has another unit, the pose found so far is that far off in depth.
    ratio = own_points[known][:, 2] / estimate.T.apply(points[known])[:, 2]
    scale = float(np.median(ratio))
    start = Sim3(estimate.T.R, scale * estimate.T.t, scale)
    similar = solve_pose(problem, start, free_scale=True)
    if similar is None or similar.covariance[6, 6] > config.max_scale_sigma**2:
        return None
    return similar


def _occupied_cells(
    pixels: Array,  # [M, 2] px
    camera: CameraModel,
) -> int:
    share = pixels / (camera.width, camera.height)
    cell = np.floor(np.clip(share, 0.0, 1.0 - 1e-9) * GRID).astype(np.int64)
    return len(np.unique(cell @ (1, GRID[0])))


# --------------------------------------------------------------------------------------------------
# Keypoints of two pictures that show the same thing.


LOWE_RATIO = 0.8
"""Distance to the nearest over distance to the second: above, the match is not clear (Lowe)."""


def take_root(
    descriptors: Float,  # [M, d]
) -> Float:
    """[M, d] of unit length: signed square roots after L1 normalisation (RootSIFT).

    No few large entries decide how near two descriptors are.
    """
    size = np.maximum(np.abs(descriptors).sum(1, keepdims=True), 1e-12)
    share = descriptors / size
    return np.asarray(np.sign(share) * np.sqrt(np.abs(share)), dtype=np.float32)


def match_keypoints(a: Keypoints, b: Keypoints) -> tuple[Index, Index]:
    """Indices [M] into a and into b of keypoints that are each other's nearest, and clearly so."""
    if len(a.pixels) == 0 or len(b.pixels) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    # Of unit length: the nearest is the one with the largest product.
    product = take_root(a.descriptors) @ take_root(b.descriptors).T
    nearest, back = product.argmax(1), product.argmax(0)
    rows = np.arange(len(product))
    best = product[rows, nearest]
    product[rows, nearest] = -np.inf
    # |x - y|^2 = 2 (1 - x . y)
    clear = 1.0 - best < LOWE_RATIO**2 * (1.0 - product.max(1))
    kept = np.nonzero(clear & (back[nearest] == rows))[0]
    return kept, nearest[kept]


# --------------------------------------------------------------------------------------------------
# Keyframes that overlap with a frame, by the poses of the keyframe graph alone.

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
