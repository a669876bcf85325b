"""What a dive keeps of the pictures in which it saw something of known size."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.config import FusionConfig, parse_config
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes import Pointmap
from aquaflow.tracking.metric.straightening import LengthSightings
from tests.telemetry.known_lengths.boards_in_pictures import (
    CAMERA,
    METRES_PER_UNIT,
    Printed,
    in_map,
    looking,
    photographed,
)

TAG = {"kind": "markers", "dictionary": "APRILTAG_36h11", "marker_m": 0.16}
VIEW = looking(np.zeros(3), np.array([0.1, -0.1, -0.9]))


def config(**changes: object) -> FusionConfig:
    return parse_config({"fusion": {"boards": [TAG], **changes}}, "test").fusion


def picture() -> np.ndarray:
    (board,) = config().boards
    return photographed([(Printed(board), Sim3.identity())], VIEW)


def pointmap() -> Pointmap:
    """Of the board's plane, z = 0, in map units, to 1 %."""
    rays = CAMERA.unproject(CAMERA.pixel_centres()) @ VIEW.R.T
    metres = -VIEW.t[2] / rays[..., 2]
    rho = METRES_PER_UNIT / metres
    return Pointmap(CAMERA, rho, (0.01 * rho) ** 2)


def test_one_keyframe_gives_a_length_once_its_depth_was_kept() -> None:
    sightings = LengthSightings(config())
    sightings.look(3, picture(), CAMERA)
    place = in_map(VIEW).T_wc, 5
    # A larger board further away looks the same.
    assert sightings.measure({3: place}.get)[5].lengths == []
    (report,) = sightings.measure({3: place}.get)[5].unknown
    assert (report.source, report.kind, report.used) == ("marker 7", "length", 0)
    assert "(1)" in report.reason
    sightings.keep_depths(3, pointmap)
    (length,) = sightings.measure({3: place}.get)[5].lengths
    assert sightings.measure({3: place}.get)[5].unknown == []
    assert (length.source, length.sub_map) == ("marker 7", 5)
    assert length.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=0.03)
    assert sightings.measure({}.get) == {}


def test_a_copy_does_not_grow() -> None:
    sightings = LengthSightings(config())
    before = sightings.copy()
    sightings.look(3, picture(), CAMERA)
    assert sightings
    assert not before


def test_a_picture_that_shows_nothing_leaves_nothing() -> None:
    sightings = LengthSightings(config())
    sightings.look(3, photographed([], VIEW), CAMERA)
    sightings.keep_depths(3, pytest.fail)
    assert not sightings


def test_nothing_is_looked_for_without_objects_in_the_settings_or_without_fusion() -> None:
    assert LengthSightings(config()).looks_for
    assert not LengthSightings(config(boards=[])).looks_for
    assert not LengthSightings(config(enabled=False)).looks_for
