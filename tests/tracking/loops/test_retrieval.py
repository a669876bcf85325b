"""Retrieval: the place is found again, other places are not proposed, and order decides nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from aquaflow.config import RetrievalConfig
from aquaflow.prior.contract import Keypoints
from aquaflow.tracking.loops import Retrieval, _similarity

DIMENSION = 48
SIZE = 400


@dataclass(eq=False)
class Place:
    """An encoding that has descriptors and nothing else."""

    keypoints: Keypoints


def descriptors(seed: int, count: int = SIZE) -> np.ndarray:
    """[count, DIMENSION] of one stretch of sea floor: correlated, as real ones are."""
    rng = np.random.default_rng(seed)
    mixing = np.random.default_rng(0).normal(size=(DIMENSION, DIMENSION))
    return (rng.normal(size=(count, DIMENSION)) @ mixing).astype(np.float32)


def place(*parts: np.ndarray) -> Place:
    stacked = np.concatenate(parts)
    return Place(Keypoints(np.zeros((len(stacked), 2), np.float32), stacked))


def seen_again(values: np.ndarray, seed: int, noise: float = 0.15) -> np.ndarray:
    rng = np.random.default_rng(1000 + seed)
    return (values + noise * values.std() * rng.normal(size=values.shape)).astype(np.float32)


def path(count: int) -> list[Place]:
    """A straight swim: each keyframe shares half of its sea floor with the next."""
    floor = [descriptors(i, SIZE // 2) for i in range(count + 1)]
    return [place(floor[i], seen_again(floor[i + 1], i)) for i in range(count)]


def revisit(of: Place, seed: int = 7) -> Place:
    return place(seen_again(of.keypoints.descriptors, seed, 0.25))


def nothing(number: int) -> bool:
    return False


def grown(places: list[Place], config: RetrievalConfig | None = None) -> Retrieval:
    retrieval = Retrieval(config or RetrievalConfig())
    for number, there in enumerate(places):
        retrieval.add(number, there)
    return retrieval


@pytest.mark.parametrize("number", [0, 1, 17, 39])
def test_a_revisited_keyframe_is_the_first_candidate(number: int) -> None:
    """The first keyframe too: it gave the vocabulary, and a dive ends where it began."""
    places = path(40)
    best = grown(places).candidates(revisit(places[number]), nothing)
    assert best[0].number == number
    assert {candidate.number for candidate in best} <= {number - 1, number, number + 1}


def test_a_place_never_seen_gives_no_candidate() -> None:
    retrieval = grown(path(40))
    for seed in range(100, 110):
        assert retrieval.candidates(place(descriptors(seed)), nothing) == []


def test_excluded_keyframes_are_left_out_and_the_next_ones_move_up() -> None:
    places = path(12)
    retrieval = grown(places)
    best = retrieval.candidates(revisit(places[5]), lambda number: number == 5)
    assert best
    assert {candidate.number for candidate in best} <= {4, 6}
    assert retrieval.candidates(revisit(places[5]), lambda number: True) == []


def test_candidates_come_in_order_and_no_more_than_asked_for() -> None:
    places = path(3)
    same = [revisit(places[1], seed) for seed in range(8)]
    retrieval = grown(places + same)
    found = retrieval.candidates(places[1], nothing, 6)
    assert len(found) == 6
    similarities = [candidate.similarity for candidate in found]
    assert similarities == sorted(similarities, reverse=True)
    assert similarities[0] == pytest.approx(1.0)
    assert len(retrieval.candidates(places[1], nothing)) == RetrievalConfig().candidates


def test_the_plausible_similarity_follows_the_neighbours_on_the_path() -> None:
    near = [place(seen_again(descriptors(1), seed)) for seed in range(5)]
    assert grown(near).plausible > 1.5 * grown(path(5)).plausible
    floor = RetrievalConfig().min_similarity
    assert grown([place(descriptors(i)) for i in range(5)]).plausible == floor


def test_the_inverted_file_says_what_comparing_one_by_one_says() -> None:
    places = path(23)
    query = revisit(places[9])
    retrieval = grown(places, RetrievalConfig(min_similarity=0.0, neighbour_share=0.0))
    wanted = retrieval._signature(query)
    assert wanted is not None
    one_by_one = {}
    for number, there in enumerate(places):
        signature = retrieval._signature(there)
        assert signature is not None
        one_by_one[number] = _similarity(signature, wanted)
    found = retrieval.candidates(query, nothing, 23)
    assert len(found) == 23
    for candidate in found:
        assert candidate.similarity == pytest.approx(one_by_one[candidate.number], rel=1e-12)


def test_numbers_need_not_be_consecutive() -> None:
    places = path(4)
    retrieval = Retrieval(RetrievalConfig())
    for number, there in zip((3, 10, 11, 40), places, strict=True):
        retrieval.add(number, there)
    assert retrieval.candidates(revisit(places[3]), nothing)[0].number == 40


def test_a_picture_that_shows_little_is_neither_kept_nor_looked_for() -> None:
    empty = place(np.zeros((0, DIMENSION), np.float32))
    retrieval = Retrieval(RetrievalConfig())
    assert retrieval.candidates(empty, nothing) == []
    retrieval.add(0, empty)
    places = path(3)
    for number, there in enumerate(places):
        retrieval.add(number + 1, there)
    assert retrieval.candidates(empty, nothing) == []
    assert retrieval.candidates(revisit(places[0]), nothing)[0].number == 1


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_descriptors_that_are_all_alike_are_survived(value: float) -> None:
    alike = place(np.full((SIZE, DIMENSION), value, np.float32))
    retrieval = grown([alike, place(descriptors(1))])
    for candidate in retrieval.candidates(alike, nothing):
        assert np.isfinite(candidate.similarity)


@pytest.mark.parametrize("dimension", [2, 8, 256])
def test_descriptors_may_have_any_length(dimension: int) -> None:
    rng = np.random.default_rng(0)
    values = [rng.normal(size=(SIZE, dimension)).astype(np.float32) for _ in range(3)]
    found = grown([place(v) for v in values]).candidates(place(values[2]), nothing, 1)
    assert found[0].number == 2


def test_the_same_dive_gives_the_same_candidates() -> None:
    places = path(10)
    query = revisit(places[4])
    assert grown(places).candidates(query, nothing) == grown(places).candidates(query, nothing)
