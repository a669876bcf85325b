"""A keypoint network as a prior: flow starts at its matches, and only when it has to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import KeyframeStore, Pointmap
from aquaflow.prior.contract import Keypoints
from aquaflow.prior.keypoint_networks.keypoint_prior import KeypointEncoding, KeypointPrior
from tests.prior.keypoint_networks.corner_network import CornerNetwork
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


class Blind(CornerNetwork):
    """A network that finds nothing in any picture."""

    def detect(self, picture: Picture) -> Keypoints:
        return super().detect(np.zeros_like(picture))


def encoded(prior: KeypointPrior, pictures: tuple[Picture, Picture]) -> list[KeypointEncoding]:
    return [prior.encode(picture, CAMERA) for picture in pictures]


@pytest.mark.usefixtures("no_sift")
def test_matches_find_what_moved_too_far_for_flow() -> None:
    prior = KeypointPrior(CornerNetwork())
    pair = prior.decode(*encoded(prior, moved_pair(shift(*FAR))))
    assert pair.valid.mean() > 0.5
    error = np.linalg.norm(pair.matches - pixel_centres() - FAR, axis=-1)
    assert np.median(error[pair.valid]) < 0.1


@pytest.mark.usefixtures("no_sift")
def test_a_good_prediction_keeps_the_network_from_running() -> None:
    network = CornerNetwork()
    prior = KeypointPrior(network)
    predicted = (pixel_centres() + FAR).astype(np.float32)
    pair = prior.decode(*encoded(prior, moved_pair(shift(*FAR))), predicted)
    assert pair.valid.mean() > 0.5
    assert network.looked == 0


def test_a_prediction_that_stands_alone_has_no_rival() -> None:
    prior = KeypointPrior(CornerNetwork())
    a, b = encoded(prior, moved_pair(shift(*FAR)))
    nothing_moved = pixel_centres().astype(np.float32)
    assert prior.decode(a, b, nothing_moved, alone=True).valid.mean() < 0.2
    assert prior.decode(a, b, nothing_moved).valid.mean() > 0.5


def test_the_network_looks_at_a_picture_once() -> None:
    network = CornerNetwork()
    prior = KeypointPrior(network)
    a, b = encoded(prior, moved_pair(shift(*FAR)))
    prior.decode(a, b)
    prior.decode(b, a)
    assert network.looked == 2


def test_where_the_network_finds_nothing_sift_does() -> None:
    prior = KeypointPrior(Blind())
    assert prior.decode(*encoded(prior, moved_pair(shift(*FAR)))).valid.mean() > 0.5


def test_without_learned_matches_the_network_never_looks() -> None:
    network = CornerNetwork()
    prior = KeypointPrior(network, learned_matches=False)
    assert prior.decode(*encoded(prior, moved_pair(shift(*FAR)))).valid.mean() > 0.5
    assert network.looked == 0


def test_keypoints_of_what_is_masked_are_left_out() -> None:
    prior = KeypointPrior(CornerNetwork())
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, : WIDTH // 2] = False
    picture = moved_pair(shift(*FAR))[0]
    found = prior.encode(picture, CAMERA, mask).features
    assert len(found.pixels) == len(found.descriptors) > 0
    assert (found.pixels[:, 0] >= WIDTH // 2).all()


def test_what_is_packed_comes_back_and_is_not_computed_again() -> None:
    network = CornerNetwork()
    prior = KeypointPrior(network)
    a, b = encoded(prior, moved_pair(shift(*FAR)))
    before = prior.decode(a, b)
    again = [prior.unpack(prior.pack(encoding), CAMERA) for encoding in (a, b)]
    np.testing.assert_array_equal(again[0].features.pixels, a.features.pixels)
    np.testing.assert_array_equal(again[0].features.descriptors, a.features.descriptors)
    np.testing.assert_array_equal(prior.decode(*again).matches, before.matches)
    assert network.looked == 2


def test_a_picture_that_was_not_looked_at_can_be_after_it_came_back() -> None:
    prior = KeypointPrior(CornerNetwork())
    a, b = encoded(prior, moved_pair(shift(*FAR)))
    assert not any(name.startswith("feature") for name in prior.pack(a))
    again = prior.unpack(prior.pack(a), CAMERA)
    np.testing.assert_array_equal(prior.decode(again, b).matches, prior.decode(a, b).matches)


def test_encodings_wait_in_files_with_their_keyframes(tmp_path: Path) -> None:
    prior = KeypointPrior(CornerNetwork())
    store = KeyframeStore(tmp_path, prior, resident=1)
    descriptors = []
    for number, picture in enumerate(moved_pair(shift(*FAR))):
        encoding = prior.encode(picture, CAMERA)
        descriptors.append(encoding.features.descriptors)
        store.add(number, 0, encoding, Sim3.identity(), Pointmap.unknown(CAMERA), 0)
    for number, expected in enumerate(descriptors):
        back = store[number].encoding
        assert isinstance(back, KeypointEncoding)
        np.testing.assert_array_equal(back.features.descriptors, expected)


def test_decoding_twice_gives_the_same_bit_for_bit() -> None:
    found = []
    for _ in range(2):
        prior = KeypointPrior(CornerNetwork())
        found.append(prior.decode(*encoded(prior, moved_pair(shift(*FAR)))).matches)
    np.testing.assert_array_equal(*found)


def test_warming_up_runs_the_network_once() -> None:
    network = CornerNetwork()
    KeypointPrior(network).warm_up()
    assert network.looked == 1


@pytest.mark.parametrize("value", [0, 128, 255])
def test_pictures_of_one_colour_give_no_matches(value: int) -> None:
    prior = KeypointPrior(CornerNetwork())
    flat = np.full((HEIGHT, WIDTH, 3), value, np.uint8)
    pair = prior.decode(*encoded(prior, (flat, flat)))
    assert not pair.valid.any()
    assert np.isfinite(pair.matches).all()
