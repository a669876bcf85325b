"""Everything of known size in a dive, from its settings to its lengths."""

from __future__ import annotations

import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.config import parse_config
from aquaflow.geometry.similarity import Sim3
from aquaflow.telemetry.known_lengths.finder import KnownLengthFinder
from tests.telemetry.known_lengths.boards_in_pictures import (
    METRES_PER_UNIT,
    Printed,
    around,
    in_map,
    photographed,
)
from tests.telemetry.known_lengths.laser_scenes import HEIGHTS, Swim, dotted

TAG = {"kind": "markers", "dictionary": "APRILTAG_36h11", "marker_m": 0.16}
CHARUCO = TAG | {"kind": "charuco", "columns": 5, "rows": 4, "square_m": 0.1}
LASERS = {"colour": "green", "spacing_m": 0.1}


def test_boards_and_lasers_of_the_settings_are_measured_with_the_poses_of_now() -> None:
    finder = KnownLengthFinder(
        parse_config({"fusion": {"boards": [TAG], "lasers": LASERS}}, "t").fusion
    )
    cameras, swim = around(3), Swim(HEIGHTS)
    board = Printed(parse_config({"fusion": {"boards": [TAG]}}, "test").fusion.boards[0])
    views = {}
    for k, T in enumerate(cameras):
        finder.look(k, photographed([(board, Sim3.identity())], T, k))
        views[k] = in_map(T)
    for k, dots in enumerate(swim.dots):
        finder.look(100 + k, dotted(dots, seed=k))
        views[100 + k] = swim.views[k]
    lengths = finder.lengths(views.get)
    assert {length.source for length in lengths} == {"marker 7", "laser dots"}
    for length in lengths:
        assert length.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=0.05)
    assert finder.lengths(lambda index: None) == []


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"boards": [TAG | {"marker_m": 0}]}, "marker_m"),
        ({"boards": [TAG | {"dictionary": "QR"}]}, "dictionary"),
        ({"boards": [CHARUCO]}, "smaller"),
        ({"lasers": LASERS | {"colour": "pink"}}, "colour"),
        ({"lasers": LASERS | {"spacing": 1}}, "spacing"),
    ],
)
def test_settings_that_are_none_are_refused_with_their_path(
    settings: dict[str, object], sentence: str
) -> None:
    with pytest.raises(ConfigError, match=sentence):
        parse_config({"fusion": settings}, "test")
