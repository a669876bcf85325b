"""``aquaflow calibrate`` as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from aquaflow.calibration.board import Board
from aquaflow.geometry.camera import CameraModel, load_camera
from tests.calibration.board_pictures import pictures
from tests.command_line import Cli

CAMERA = CameraModel(480, 360, 400.0, 400.0, 240.0, 180.0, "radtan", (-0.1, 0.02, 0.0, 0.0))
OPTIONS = ["--columns", "7", "--rows", "5", "--square-mm", "50"]


def test_pictures_become_a_camera_file_with_sigmas(tmp_path: Path, command: Cli) -> None:
    (tmp_path / "p").mkdir()
    for name, image in pictures(CAMERA, Board("charuco", 7, 5, 0.05), 10, 0.55):
        cv2.imwrite(str(tmp_path / "p" / name), image)
    out = tmp_path / "out"
    done = command("calibrate", str(tmp_path / "p"), *OPTIONS, "--out", str(out), "--json")
    figures = json.loads(done.out)
    assert figures["used"] == 10
    assert figures["sigma"]["fx"] > 0.0
    assert load_camera(out / "camera.yaml").fx == pytest.approx(400.0, rel=5e-3)
    assert (out / "residuals.png").is_file()


def test_a_board_is_printed(tmp_path: Path, command: Cli) -> None:
    done = command("calibrate", "--print-board", str(tmp_path / "board.pdf"), *OPTIONS)
    assert "measure the squares: 50 mm" in done.out
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give the pictures of the board"),
        (["p", "--model", "wide"], "neither radtan nor fisheye"),
        (["p", "--board", "chess"], "neither charuco nor apriltag"),
        (["p", "--square-mm", "0"], "between 1 and 1000"),
    ],
)
def test_wrong_arguments_are_refused_in_a_sentence(
    arguments: list[str], message: str, command: Cli
) -> None:
    done = command("calibrate", *arguments)
    assert done.code == 2
    assert message in " ".join(done.err.replace("│", " ").split())
