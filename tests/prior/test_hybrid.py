"""The hybrid prior: flow starts where descriptors say, and only when it has to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore, Pointmap
from aquaflow.prior import homography
from aquaflow.prior.classical import ClassicalPrior
from aquaflow.prior.dense_matching import DenseViews
from aquaflow.prior.hybrid import HybridEncoding, HybridPrior
from tests.prior.patch_describer import PatchDescriber, PatchPair
from tests.prior.textured_pictures import (
    CAMERA,
    FAR,
    HEIGHT,
    WIDTH,
    Picture,
    moved_pair,
    pixel_centres,
    shift,
)


class Mute(PatchDescriber):
    """A network that says the same of every cell."""

    def features(self, picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.float16]:
        return np.full((HEIGHT // 8, WIDTH // 8, 4), 0.5, np.float16)


class Pixels(Mute):
    """Cells tell it nothing, but it knows the points of all pixels of pictures shifted by FAR."""

    describes = "pixels"

    def compare(self, *_: object) -> PatchPair:  # type: ignore[override]
        there, here, back = (
            CAMERA.unproject(pixel_centres() + by).astype(np.float32)
            for by in (np.array(FAR), np.zeros(2), -np.array(FAR))
        )
        same = np.full((HEIGHT, WIDTH, 4), 0.5, np.float32)
        views = DenseViews(there, here, same, same), DenseViews(back, here, same, same)
        return PatchPair((same[::8, ::8], same[::8, ::8]), views)


def encoded(prior: HybridPrior, pictures: tuple[Picture, Picture]) -> tuple[HybridEncoding, ...]:
    return tuple(prior.encode(picture, CAMERA) for picture in pictures)


@pytest.mark.usefixtures("no_sift")
def test_descriptors_find_what_moved_too_far_for_flow() -> None:
    prior = HybridPrior(PatchDescriber())
    pair = prior.decode(*encoded(prior, moved_pair(shift(*FAR))))
    assert pair.valid.mean() > 0.5
    error = np.linalg.norm(pair.matches - pixel_centres() - FAR, axis=-1)
    assert np.median(error[pair.valid]) < 0.1


@pytest.mark.usefixtures("no_sift")
def test_points_of_all_pixels_are_matched_where_a_network_gives_them() -> None:
    prior = HybridPrior(Pixels())
    pair = prior.decode(*encoded(prior, moved_pair(shift(*FAR))))
    assert pair.valid.mean() > 0.5
    error = np.linalg.norm(pair.matches - pixel_centres() - FAR, axis=-1)
    assert np.median(error[pair.valid]) < 0.1


def test_matches_of_the_networks_own_need_no_texture_and_no_flow() -> None:
    prior = HybridPrior(Pixels(), own_matches=True)
    bare = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    pair = prior.decode(*encoded(prior, (bare, bare)))
    there = pixel_centres() + FAR
    seen = ((there > 3.0) & (there < [WIDTH - 3.0, HEIGHT - 3.0])).all(-1)
    assert pair.valid[seen].all()
    assert np.abs(pair.matches - there)[seen].max() < 0.02
    assert (pair.C[seen] > 0.5).mean() > 0.9
    assert pair.valid_back.any()
    elsewhere = pixel_centres().astype(np.float32)
    alone = prior.decode(*encoded(prior, (bare, bare)), elsewhere, alone=True)
    assert not alone.valid.any()


def test_how_it_matches_is_said_and_follows_what_the_network_describes() -> None:
    assert HybridPrior(Pixels()).matching == "flow from points and descriptors of pixels"
    assert HybridPrior(PatchDescriber()).matching == "flow from descriptors of cells"
    own = "points and descriptors of pixels, without flow"
    assert HybridPrior(Pixels(), own_matches=True).matching == own
    assert HybridPrior(PatchDescriber(), own_matches=True).matching != own
    without = HybridPrior(Pixels(), learned_matches=False)
    assert without.matching == ClassicalPrior().matching == "flow from SIFT"


@pytest.mark.usefixtures("no_sift")
def test_a_good_prediction_keeps_the_network_from_running() -> None:
    describer = PatchDescriber()
    prior = HybridPrior(describer)
    predicted = (pixel_centres() + FAR).astype(np.float32)
    pair = prior.decode(*encoded(prior, moved_pair(shift(*FAR))), predicted)
    assert pair.valid.mean() > 0.5
    assert describer.asked == 0


@pytest.mark.parametrize("prior", [ClassicalPrior(), HybridPrior(PatchDescriber())])
def test_a_prediction_that_stands_alone_has_no_rival(prior: ClassicalPrior | HybridPrior) -> None:
    """Whether it explains the pair is what is asked; what else would, must not answer."""
    pictures = [prior.encode(picture, CAMERA) for picture in moved_pair(shift(*FAR))]
    nothing_moved = pixel_centres().astype(np.float32)
    alone = prior.decode(pictures[0], pictures[1], nothing_moved, alone=True)
    free = prior.decode(pictures[0], pictures[1], nothing_moved)
    assert alone.valid.mean() < 0.2
    assert free.valid.mean() > 0.5


def test_a_picture_is_described_once() -> None:
    describer = PatchDescriber()
    prior = HybridPrior(describer)
    a, b = encoded(prior, moved_pair(shift(*FAR)))
    prior.decode(a, b)
    prior.decode(b, a)
    assert describer.asked == 2


def test_where_descriptors_say_nothing_keypoints_do() -> None:
    prior = HybridPrior(Mute())
    pair = prior.decode(*encoded(prior, moved_pair(shift(*FAR))))
    assert pair.valid.mean() > 0.5


def test_where_nothing_helps_flow_starts_from_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(homography, "homography", lambda *_: None)
    hybrid, classical = HybridPrior(Mute()), ClassicalPrior()
    pictures = moved_pair(shift(3.0, 1.0))
    plain = classical.decode(*(classical.encode(picture, CAMERA) for picture in pictures))
    found = hybrid.decode(*encoded(hybrid, pictures))
    np.testing.assert_array_equal(found.matches, plain.matches)


def test_decoding_twice_gives_the_same_bit_for_bit() -> None:
    found = []
    for _ in range(2):
        prior = HybridPrior(PatchDescriber())
        found.append(prior.decode(*encoded(prior, moved_pair(shift(*FAR)))).matches)
    np.testing.assert_array_equal(*found)


def test_what_is_packed_comes_back_and_is_not_computed_again() -> None:
    describer = PatchDescriber()
    prior = HybridPrior(describer)
    a, b = encoded(prior, moved_pair(shift(*FAR)))
    before = prior.decode(a, b)
    again = [prior.unpack(prior.pack(encoding), CAMERA) for encoding in (a, b)]
    asked = describer.asked
    np.testing.assert_array_equal(prior.decode(*again).matches, before.matches)
    assert describer.asked == asked


def test_what_was_never_described_can_be_after_it_came_back() -> None:
    prior = HybridPrior(PatchDescriber())
    a, b = encoded(prior, moved_pair(shift(*FAR)))
    assert "features" not in prior.pack(a)
    again = prior.unpack(prior.pack(a), CAMERA)
    np.testing.assert_array_equal(prior.decode(again, b).matches, prior.decode(a, b).matches)


def test_encodings_wait_in_files_with_their_keyframes(tmp_path: Path) -> None:
    prior = HybridPrior(PatchDescriber())
    store = KeyframeStore(tmp_path, prior, resident=1)
    pictures = moved_pair(shift(*FAR))
    features = []
    for number, picture in enumerate((*pictures, *pictures)):
        encoding = prior.encode(picture, CAMERA)
        features.append(encoding.features)
        store.add(number, 0, encoding, Sim3.identity(), Pointmap.unknown(CAMERA), 0)
    for number, expected in enumerate(features):
        back = store[number].encoding
        assert isinstance(back, HybridEncoding)
        np.testing.assert_array_equal(back.features, expected)


def test_warming_up_asks_the_network_once() -> None:
    describer = PatchDescriber()
    HybridPrior(describer).warm_up()
    assert describer.asked == 1


@pytest.mark.parametrize("value", [0, 128, 255])
def test_pictures_of_one_colour_give_no_matches(value: int) -> None:
    prior = HybridPrior(PatchDescriber())
    flat = np.full((HEIGHT, WIDTH, 3), value, np.uint8)
    pair = prior.decode(*encoded(prior, (flat, flat)))
    assert not pair.valid.any()
    assert np.isfinite(pair.matches).all()


def test_ranges_of_both_pictures_are_the_networks() -> None:
    prior = HybridPrior(PatchDescriber())
    pair = prior.decode(*encoded(prior, moved_pair(shift(*FAR))))
    assert prior.ranged
    for X, Q in ((pair.X_a, pair.Q_a), (pair.X_b, pair.Q_b)):
        assert X is not None
        assert Q is not None
        np.testing.assert_allclose(np.linalg.norm(X, axis=-1), 3.0, rtol=1e-4)
        np.testing.assert_allclose(Q, 1.0 / 0.09, rtol=1e-3)


def test_ranges_are_asked_for_once_and_only_when_needed() -> None:
    describer = PatchDescriber()
    prior = HybridPrior(describer)
    predicted = (pixel_centres() + FAR).astype(np.float32)
    pair = prior.decode(*encoded(prior, moved_pair(shift(*FAR))), predicted)
    assert describer.compared_pairs == 0
    for _ in range(2):
        assert pair.X_a is not None
        assert pair.X_b is not None
    assert describer.compared_pairs == 1
