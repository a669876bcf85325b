"""Calibrating: the camera that took the pictures comes back, and poor pictures are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors import ConfigError, InputError
from aquaflow.calibration.board import LEAST_VIEWS, Board, BoardKind, Detector, draw, write_board
from aquaflow.calibration.calibrate import Calibration, calibrate, write_calibration
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.geometry.port import FlatPort
from tests.calibration.board_pictures import Image, pictures, taken

BOARD = Board("charuco", 9, 7, 0.04)
RADTAN = CameraModel(640, 480, 520.0, 522.0, 316.0, 243.0, "radtan", (-0.25, 0.08, 1e-3, -5e-4))
FISHEYE = CameraModel(640, 480, 300.0, 300.5, 322.0, 238.0, "fisheye", (0.02, -0.005, 1e-3, 0.0))
BEHIND_GLASS = replace(RADTAN, port=FlatPort(0.05, 0.01))


def written(folder: Path, made: list[tuple[str, Image]]) -> Path:
    folder.mkdir()
    for name, image in made:
        assert cv2.imwrite(str(folder / name), image)
    return folder


@pytest.fixture(scope="module")
def through_glass(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = pictures(BEHIND_GLASS, BOARD, 12, 0.55)
    return written(tmp_path_factory.mktemp("port") / "pictures", made)


@pytest.fixture(scope="module")
def lens_behind_glass(through_glass: Path) -> Calibration:
    return calibrate(through_glass, BOARD, "radtan", known=BEHIND_GLASS)


@pytest.mark.parametrize(
    ("camera", "kind", "range_m"),
    [(RADTAN, "charuco", 0.55), (RADTAN, "apriltag", 0.55), (FISHEYE, "charuco", 0.4)],
    ids=["radtan", "apriltags", "fisheye"],
)
def test_the_lens_that_took_the_pictures_comes_back_within_its_sigma(
    tmp_path: Path, camera: CameraModel, kind: BoardKind, range_m: float
) -> None:
    board = replace(BOARD, kind=kind)
    source = written(tmp_path / "pictures", pictures(camera, board, 12, range_m))
    model = "fisheye" if camera.distortion_model == "fisheye" else "radtan"
    fit = calibrate(source, board, model).fit
    truth = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
    assert np.abs((fit.values - truth) / fit.sigma).max() < 3.5
    assert fit.camera.fx == pytest.approx(camera.fx, rel=3e-3)
    assert fit.sigma[0] < 3e-3 * camera.fx
    assert fit.rms_px < 0.25


def test_the_lens_behind_a_known_port_comes_back(lens_behind_glass: Calibration) -> None:
    fit = lens_behind_glass.fit
    assert fit.camera.port == BEHIND_GLASS.port
    assert fit.camera.fx == pytest.approx(520.0, rel=3e-3)
    assert abs(fit.camera.fx - 520.0) < 3.0 * fit.sigma[0]


def test_the_place_of_a_port_comes_back_where_the_lens_is_known(through_glass: Path) -> None:
    guess = replace(BEHIND_GLASS, port=FlatPort(0.02, 0.01, normal=(0.06, 0.0, 0.9982)))
    fit = calibrate(through_glass, BOARD, "radtan", known=guess, estimate_port=True).fit
    assert fit.names == ("distance_m", "normal_x", "normal_y")
    assert fit.values == pytest.approx([0.05, 0.0, 0.0], abs=3e-3)
    assert np.abs((fit.values - [0.05, 0.0, 0.0]) / fit.sigma).max() < 3.5


def test_a_result_is_a_camera_file_figures_and_a_picture(
    tmp_path: Path, lens_behind_glass: Calibration
) -> None:
    found = lens_behind_glass
    camera, figures, plot, ros, opencv = write_calibration(found, tmp_path / "new" / "folder")
    assert load_camera(camera) == found.fit.camera
    assert ros.name == "camera_ros.yaml"
    assert opencv.name == "camera_opencv.yaml"
    numbers = json.loads(figures.read_text())
    assert set(numbers["sigma"]) == {"fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"}
    assert len(numbers["rms_px_of_pictures"]) == numbers["used"] == 12
    image = cv2.imread(str(plot))
    assert image is not None
    assert image.std() > 5.0


def test_pictures_that_are_alike_are_refused(tmp_path: Path) -> None:
    name, image = pictures(RADTAN, BOARD, 1, 0.55)[0]
    source = written(tmp_path / "p", [(f"{k}{name}", image) for k in range(LEAST_VIEWS + 2)])
    with pytest.raises(InputError, match="only 1 of 10 pictures of the board differ"):
        calibrate(source, BOARD, "radtan")


def test_too_few_pictures_of_the_board_are_refused(tmp_path: Path) -> None:
    made = pictures(RADTAN, BOARD, 2, 0.55)
    empty = [(f"z{k}.png", np.full_like(made[0][1], 90)) for k in range(8)]
    source = written(tmp_path / "p", made + empty)
    with pytest.raises(InputError, match="2 of 10 pictures show the board, 8 are needed"):
        calibrate(source, BOARD, "radtan")


def test_a_board_that_never_tilts_leaves_the_focal_length_open(tmp_path: Path) -> None:

    straight = [
        (
            f"{k}.png",
            taken(RADTAN, BOARD, np.eye(3), np.array([0.05 * (k - 6), -0.14, 0.6]), seed=k),
        )
        for k in range(9)
    ]
    with pytest.raises(InputError, match="leave the focal length open"):
        calibrate(written(tmp_path / "p", straight), BOARD, "radtan")


def test_a_port_is_estimated_only_where_there_is_a_flat_one(through_glass: Path) -> None:
    with pytest.raises(ConfigError, match="needs a known camera with the lens in air"):
        calibrate(through_glass, BOARD, "radtan", known=RADTAN, estimate_port=True)


@pytest.mark.parametrize("kind", ["charuco", "apriltag"])
def test_a_printed_board_is_found_whole_and_straight(kind: BoardKind) -> None:
    board = Board(kind, 7, 5, 0.03)
    found = Detector(board)(draw(board, 80))
    corners = {"charuco": 6 * 4, "apriltag": 7 * 5 * 4}[kind]
    assert len(found.numbers) == corners
    expected = found.points_m[:, :2] / board.square_m * 80.0 + 40.0
    np.testing.assert_allclose(found.pixels, expected, atol=0.2)


@pytest.mark.parametrize("name", ["board.pdf", "board.png"])
def test_a_board_prints_at_its_true_size(tmp_path: Path, name: str) -> None:
    from PIL import Image as Picture

    board = Board("charuco", 7, 5, 0.03)
    write_board(board, tmp_path / name)
    if name.endswith("png"):
        with Picture.open(tmp_path / name) as image:
            inches = image.width / image.info["dpi"][0]
        assert inches * 25.4 == pytest.approx(8 * 30.0, rel=1e-3)
    else:
        text = (tmp_path / name).read_bytes()
        box = text[text.index(b"/MediaBox") :].split(b"[")[1].split(b"]")[0].split()
        assert float(box[2]) / 72.0 * 25.4 == pytest.approx(8 * 30.0, rel=1e-3)


def test_boards_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="too small to calibrate with"):
        Detector(Board("charuco", 2, 7, 0.03))
    with pytest.raises(ConfigError, match="needs 600 markers"):
        Detector(Board("apriltag", 30, 20, 0.03))
    with pytest.raises(ConfigError, match=r"neither a \.pdf nor a \.png"):
        write_board(BOARD, tmp_path / "board.jpg")
