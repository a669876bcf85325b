"""Boards of known size in pictures: found where they are, measured in the map, else refused."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from aquaflow.config.telemetry import BoardConfig, CharucoConfig, MarkersConfig
from aquaflow.geometry.similarity import Sim3, so3_exp
from aquaflow.telemetry.known_lengths.board_size import (
    BoardDetector,
    BoardSighting,
    BoardView,
    board_lengths,
    marker_corners,
)
from aquaflow.telemetry.known_lengths.known_length import KnownLength
from tests.telemetry.known_lengths.boards_in_pictures import (
    CAMERA,
    METRES_PER_UNIT,
    Printed,
    around,
    in_map,
    photographed,
)

TAG = MarkersConfig(dictionary="APRILTAG_36h11", marker_m=0.16)
ARUCO = MarkersConfig(dictionary="4X4_50", marker_m=0.12)
CHARUCO = CharucoConfig(dictionary="5X5_100", columns=7, rows=5, square_m=0.06, marker_m=0.045)
BOARDS: dict[str, BoardConfig] = {"apriltag": TAG, "aruco": ARUCO, "charuco": CHARUCO}
CENTRED = {"charuco": Sim3(np.eye(3), np.array([-0.21, -0.15, 0.0]))}
"""A ChArUco board's origin is its corner."""


def pose_of(name: str) -> Sim3:
    return CENTRED.get(name, Sim3.identity())


def seen(
    boards: Sequence[BoardConfig], pictures: Sequence[np.ndarray], first: int = 0
) -> list[BoardSighting]:
    detector = BoardDetector(boards)
    return [each for k, picture in enumerate(pictures, first) for each in detector(k, picture)]


def lengths(
    sightings: Sequence[BoardSighting], views: Sequence[BoardView | None]
) -> list[KnownLength]:
    return board_lengths(sightings, lambda index: views[index])


@pytest.mark.parametrize("name", BOARDS)
def test_a_board_in_four_views_gives_the_metres_of_a_map_unit(name: str) -> None:
    board = Printed(BOARDS[name])
    cameras = around(4)
    pictures = [photographed([(board, pose_of(name))], T, k) for k, T in enumerate(cameras)]
    sightings = seen([board.config], pictures)
    assert len(sightings) == len(cameras)
    (length,) = lengths(sightings, [in_map(T) for T in cameras])
    error = length.metres_per_unit / METRES_PER_UNIT - 1.0
    assert abs(error) < 0.005
    assert abs(error) < 4.0 * length.relative_sigma
    assert length.relative_sigma < 0.02


@pytest.mark.parametrize("name", BOARDS)
def test_corners_are_found_to_a_fraction_of_a_pixel(name: str) -> None:
    board, (T,) = Printed(BOARDS[name]), around(1)
    (sighting,) = seen([board.config], [photographed([(board, pose_of(name))], T)])
    down = np.array([1.0, -1.0, 1.0]) if sighting.marker is not None else np.ones(3)
    true = CAMERA.project(T.inverse().apply(pose_of(name).apply(sighting.points_m * down)))
    assert np.sqrt(np.mean((sighting.pixels - true) ** 2)) < 0.3


def test_one_view_gives_a_scale_only_with_the_pictures_depth() -> None:
    board, (T,) = Printed(TAG), around(1)
    sightings = seen([TAG], [photographed([(board, Sim3.identity())], T)])
    assert lengths(sightings, [in_map(T)]) == []
    rho = np.full((CAMERA.height, CAMERA.width), METRES_PER_UNIT / np.linalg.norm(T.t))
    (length,) = lengths(sightings, [in_map(T, rho)])
    assert abs(length.metres_per_unit / METRES_PER_UNIT - 1.0) < 0.03
    assert 0.008 < length.relative_sigma < 0.03


def test_a_pose_of_another_scale_changes_nothing() -> None:
    board, cameras = Printed(TAG), around(3)
    pictures = [photographed([(board, Sim3.identity())], T, k) for k, T in enumerate(cameras)]
    views = [in_map(T) for T in cameras]
    stretched = [
        BoardView(view.camera, Sim3(view.T_wc.R, view.T_wc.t, 1.7), view.sub_map) for view in views
    ]
    (plain,), (other,) = (lengths(seen([TAG], pictures), each) for each in (views, stretched))
    assert other.metres_per_unit == pytest.approx(plain.metres_per_unit, rel=1e-6)


@pytest.mark.slow
def test_the_stated_sigma_is_true() -> None:
    rng, cameras, squares = np.random.default_rng(5), around(5), []
    points = marker_corners(0.16)
    for _ in range(60):
        sightings, views = [], []
        for k, T in enumerate(cameras):
            pixels = CAMERA.project(T.inverse().apply(points * np.array([1.0, -1.0, 1.0])))
            pixels += rng.normal(0.0, 0.3, pixels.shape)
            sightings.append(BoardSighting(k, 0, 7, points, pixels, 0.16, 1e-6))
            view = in_map(T)
            unit = 0.5 / CAMERA.fx
            turn = so3_exp(rng.normal(0.0, unit, 3))
            shift = rng.normal(0.0, unit * 0.95 / METRES_PER_UNIT, 3)
            wrong = Sim3(view.T_wc.R @ turn, view.T_wc.t + shift)
            views.append(BoardView(CAMERA, wrong, 0))
        (length,) = lengths(sightings, views)
        error = np.log(length.metres_per_unit / METRES_PER_UNIT)
        squares.append((error / length.relative_sigma) ** 2)
    assert 0.6 < np.mean(squares) < 1.5


def test_sub_maps_are_measured_apart() -> None:
    board, cameras = Printed(TAG), around(6)
    pictures = [photographed([(board, Sim3.identity())], T, k) for k, T in enumerate(cameras)]
    views = [in_map(T, sub_map=k % 2) for k, T in enumerate(cameras)]
    assert {each.sub_map for each in lengths(seen([TAG], pictures), views)} == {0, 1}


def test_a_frame_without_a_pose_is_left_out() -> None:
    board, cameras = Printed(TAG), around(3)
    pictures = [photographed([(board, Sim3.identity())], T, k) for k, T in enumerate(cameras)]
    sightings = seen([TAG], pictures)
    assert lengths(sightings, [in_map(cameras[0]), None, None]) == []
    assert len(lengths(sightings, [in_map(cameras[0]), None, in_map(cameras[2])])) == 1


# --- refused --------------------------------------------------------------------------------------


def test_a_board_that_moved_between_the_views_gives_no_length() -> None:
    board, cameras = Printed(TAG), around(4)
    moved = [Sim3(np.eye(3), np.array([0.08 * (k % 2), 0.0, 0.0])) for k in range(4)]
    pictures = [photographed([(board, T_nb)], T) for T_nb, T in zip(moved, cameras, strict=True)]
    assert lengths(seen([TAG], pictures), [in_map(T) for T in cameras]) == []


def test_views_without_parallax_give_no_length() -> None:
    board, cameras = Printed(TAG), around(4, swing_m=0.002)
    still = [Sim3(T.R, cameras[0].t + 1e-3 * k) for k, T in enumerate(cameras)]
    pictures = [photographed([(board, Sim3.identity())], T) for T in still]
    assert lengths(seen([TAG], pictures), [in_map(T) for T in still]) == []


def test_a_marker_that_is_there_twice_is_not_seen() -> None:
    board, (T,) = Printed(TAG), around(1)
    twice = [(board, Sim3(np.eye(3), np.array([x, 0.0, 0.0]))) for x in (-0.18, 0.18)]
    assert seen([TAG], [photographed(twice, T)]) == []


def test_a_marker_too_small_to_read_is_not_seen() -> None:
    board = Printed(MarkersConfig(dictionary="4X4_50", marker_m=0.02))
    (T,) = around(1)
    assert seen([board.config], [photographed([(board, Sim3.identity())], T)]) == []


def test_markers_of_another_dictionary_or_number_are_not_seen() -> None:
    (T,) = around(1)
    picture = photographed([(Printed(TAG), Sim3.identity())], T)
    assert seen([ARUCO], [picture]) == []
    others = MarkersConfig(dictionary="APRILTAG_36h11", marker_m=0.16, ids=(1, 2))
    assert seen([others], [picture]) == []


@pytest.mark.parametrize("name", BOARDS)
def test_a_sea_floor_without_boards_shows_none(name: str) -> None:
    cameras = around(5)
    assert seen([BOARDS[name]], [photographed([], T, k) for k, T in enumerate(cameras)]) == []


def test_a_corner_of_a_charuco_board_is_not_a_board() -> None:
    board, T = Printed(CHARUCO), around(1)[0]
    picture = photographed([(board, Sim3(np.eye(3), np.array([-0.74, -0.47, 0.0])))], T)
    assert seen([CHARUCO], [picture]) == []
