"""``index.npz``: one index of the keyframes of all dives of a site, to find those that look alike.

A dive is read once, when it is added. What is asked later needs no dive's files, and what has to be
proved of a keyframe is bounded, however many dives there are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.base.errors import DamagedError, InputError
from aquaflow.base.storage.archive import UNREADABLE, read_facts_file, write_facts_file
from aquaflow.config import RetrievalConfig
from aquaflow.keyframes.place import PlacesFile
from aquaflow.tracking.loops import InvertedFile, Signature, Vocabulary, take_root

NAME = "index.npz"
"""In a site's folder."""
FORMAT = 1
"""Raised whenever the same dives would give another index."""
RETRIEVAL = RetrievalConfig(min_similarity=0.01)
"""A place in another dive, seen in other water and light, is less like itself than neighbours on a
path are: the true pairs of the reef clip's halves have similarities from 0.02. So only what chance
gives is asked for, and the proof decides."""
MOST_OF_A_DIVE = 5
"""Keyframes of one dive that a keyframe is compared with."""
MOST_CANDIDATES = 10
"""Keyframes of the whole site that a keyframe is compared with."""
MOST_SIMILAR = 256
"""Keyframes among which those are chosen."""
OWNER = np.dtype([("dive", "<i4"), ("number", "<i8"), ("words", "<i4")])
"""A keyframe: index of its dive, its number there, and how many words it has."""
VOCABULARY = tuple(each.name for each in fields(Vocabulary))
"""Arrays of the vocabulary."""
MOST_BYTES = 1 << 31
"""Of an index: a keyframe takes 5 kB."""

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class SimilarPlace:
    """A keyframe of another dive that may show the same place."""

    dive: str
    """Fingerprint of the dive."""
    number: int
    """Of the keyframe in it."""
    similarity: float
    """By the words of the two pictures: 0 to 1, about 0.01 by chance."""


class PlaceIndex:
    """Dives are known by their fingerprints; the same dives in the same order give the same index,
    and its words are drawn from the first."""

    def __init__(self) -> None:
        self.dives: list[str] = []
        """Fingerprints in the order of adding."""
        self._vocabulary: Vocabulary | None = None
        self._place: dict[tuple[str, int], int] = {}
        self._owners: list[tuple[int, int]] = []
        self._signatures: list[Signature] = []
        self._built: tuple[InvertedFile, Array] | None = None

    def add(self, dive: str, places: PlacesFile) -> None:
        """Add a dive's keyframes; those that show nothing to recognise are left out.

        Raises:
            InputError: a keyframe is damaged, or described by other numbers than the others are.
        """
        found = []
        for place in places.places:
            descriptors = take_root(places.keypoints(place.number).keypoints.descriptors)
            if len(descriptors) < RETRIEVAL.min_descriptors:
                continue
            if self._vocabulary is None:
                self._vocabulary = Vocabulary.drawn(descriptors, RETRIEVAL.words)
            own, of_others = descriptors.shape[1], len(self._vocabulary.mean)
            if own != of_others:
                raise InputError(
                    f"{places.path} describes a keypoint by {own} numbers, the site's other dives "
                    f"by {of_others}; map it with the same prior"
                )
            found.append((place.number, self._vocabulary.signature(descriptors)))
        self.dives.append(dive)
        for number, signature in found:
            self._remember(len(self.dives) - 1, number, signature)

    def _remember(self, dive: int, number: int, signature: Signature) -> None:
        self._place[self.dives[dive], number] = len(self._owners)
        self._owners.append((dive, number))
        self._signatures.append(signature)
        self._built = None

    @property
    def _file(self) -> tuple[InvertedFile, Array]:
        """The keyframes by their words, and [N] the dive of each."""
        if self._built is None:
            file = InvertedFile.of(self._signatures, RETRIEVAL.words)
            self._built = file, np.array([dive for dive, _ in self._owners])
        return self._built

    def similar(self, dive: str, number: int, among: Collection[str]) -> list[SimilarPlace]:
        """Keyframes of the dives ``among`` that may show the place of keyframe ``number`` of
        ``dive``: the most promising first. Of several of one dive the most similar counts in full,
        the second half as much, the third a third."""
        own = self._place.get((dive, number))
        if own is None:
            return []
        file, of_dive = self._file
        similarity = file.similarities(self._signatures[own])
        asked = set(among)
        allowed = np.array([each in asked for each in self.dives])
        plausible = np.flatnonzero((similarity >= RETRIEVAL.min_similarity) & allowed[of_dive])
        best = plausible[np.argsort(-similarity[plausible], kind="stable")][:MOST_SIMILAR]
        before, ranked = Counter[int](), []
        for place in best.tolist():
            earlier = before[of_dive[place]]
            before[of_dive[place]] += 1
            if earlier < MOST_OF_A_DIVE:
                ranked.append((-similarity[place] / (1 + earlier), place))
        return [
            SimilarPlace(self.dives[dive], keyframe, float(similarity[place]))
            for _, place in sorted(ranked)[:MOST_CANDIDATES]
            for dive, keyframe in [self._owners[place]]
        ]

    def write(self, site: Path) -> None:
        """Write it into the site's folder.

        Raises:
            InputError: the file cannot be written.
        """
        sizes = [len(signature.words) for signature in self._signatures]
        rows = [(*owner, size) for owner, size in zip(self._owners, sizes, strict=True)]
        arrays: dict[str, Array] = {"owners": np.array(rows, OWNER)}
        if self._vocabulary is not None:
            words = [signature.words for signature in self._signatures]
            arrays["words"] = np.concatenate(words).astype(np.uint16)
            arrays["signs"] = np.concatenate([each.signs for each in self._signatures])
            for name in VOCABULARY:
                arrays[f"vocabulary_{name}"] = getattr(self._vocabulary, name)
        write_facts_file(site / NAME, {"format": FORMAT, "dives": self.dives}, arrays)


def read_index(site: Path, wanted: Collection[str]) -> PlaceIndex:
    """The index in a site's folder, without dives whose fingerprints are not ``wanted``; an empty
    one where there is none that can be used."""
    index = PlaceIndex()
    try:
        about, arrays = read_facts_file(site / NAME, most_bytes=MOST_BYTES)
        owners = arrays["owners"]
        if about["format"] != FORMAT or owners.dtype != OWNER:
            return index
        dives = [str(each) for each in about["dives"]]
        if not len(owners):
            index.dives = dives
            return index
        vocabulary = Vocabulary(*(arrays[f"vocabulary_{name}"] for name in VOCABULARY))
        words, signs = arrays["words"].astype(np.int64), arrays["signs"]
        ends = np.cumsum(owners["words"])
        whole = len(words) == len(signs) == ends[-1] and (owners["words"] > 0).all()
        if not whole or words.max() >= RETRIEVAL.words or signs.dtype != np.uint64:
            raise DamagedError("its words are none")
        index.dives, index._vocabulary = [each for each in dives if each in wanted], vocabulary
        place = {each: number for number, each in enumerate(index.dives)}
        for owner, end in zip(owners, ends.tolist(), strict=True):
            if dives[owner["dive"]] in place:
                own = slice(end - int(owner["words"]), end)
                number = place[dives[owner["dive"]]]
                index._remember(number, int(owner["number"]), Signature(words[own], signs[own]))
    except (*UNREADABLE, IndexError, AttributeError):
        return PlaceIndex()
    return index
