"""A dive with nothing but pictures becomes metric by a board of known size that comes into view."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.config import parse_config
from aquaflow.geometry.alignment import align
from aquaflow.geometry.camera import CameraModel, load_camera
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.evaluation.trajectory_error import associate, read_tum
from tests.command_line import run_aquaflow
from tests.small_recording import HASTY
from tests.telemetry.known_lengths.boards_in_pictures import Printed

TAG = {"kind": "markers", "dictionary": "APRILTAG_16h5", "marker_m": 0.7, "sigma_m": 0.002}
"""A poster, so that the small pictures show it with 50 px."""


def poses_of(recording: Path) -> list[Sim3]:
    path = read_tum(recording / "poses.tum")
    return [Sim3(R, t) for R, t in zip(path.R_wc, path.positions, strict=True)]


def board_in(recording: Path, camera: CameraModel, T_nc: Sim3, frame: int) -> Sim3:
    """Just before the sea floor, parallel to a picture, in the middle of it."""
    ranges = np.load(recording / "range" / f"{frame:06d}.npz")["range_m"]
    distance = 0.8 * float(ranges[camera.height // 2, camera.width // 2])
    return Sim3(T_nc.R, T_nc.apply(np.array([0.0, 0.0, distance])))


def paste(picture: Path, board: Printed, T_nb: Sim3, camera: CameraModel, T_nc: Sim3) -> None:
    """Draw the board into a picture, four times finer at first."""
    seen = T_nc.inverse().apply(T_nb.apply(board.corners()))
    if (seen[:, 2] < 0.2).any():
        return
    finer, (h, w) = 4, board.drawing.shape
    flat = np.array([[0, 0], [w, 0], [w, h], [0, h]]) - 0.5
    pixels = finer * camera.project(seen) - 0.5
    M = cv2.getPerspectiveTransform(flat.astype(np.float32), pixels.astype(np.float32))
    image = cv2.imread(str(picture))
    size = (finer * camera.width, finer * camera.height)
    large = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    tone = np.repeat((20.0 + 0.7 * board.drawing)[..., None], 3, axis=2).astype(np.uint8)
    cv2.warpPerspective(tone, M, size, large, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    small = cv2.resize(large, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(picture), small)


@pytest.fixture(scope="module")
def recording(small_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small recording with a marker in it, and without telemetry."""
    folder = tmp_path_factory.mktemp("board") / "recording"
    shutil.copytree(small_recording, folder)
    (folder / "telemetry.csv").unlink()
    camera, poses = load_camera(folder / "camera.yaml"), poses_of(folder)
    (config,) = parse_config({"fusion": {"boards": [TAG]}}, "test").fusion.boards
    board, T_nb = Printed(config), board_in(folder, camera, poses[12], 12)
    for index, T_nc in enumerate(poses):
        paste(folder / "images" / f"{index:06d}.png", board, T_nb, camera, T_nc)
    return folder


@pytest.fixture(scope="module")
def dive(recording: Path) -> Path:
    settings = recording.parent / "board.yaml"
    hasty = Path(HASTY[1]).read_text()
    settings.write_text(f"{hasty}\nfusion: {json.dumps({'boards': [TAG]})}\n")
    out = recording.parent / "dive"
    ran = run_aquaflow("map", recording, "--out", out, "--config", settings)
    assert ran.code == 0, ran.err
    return out


def test_a_board_gives_a_dive_without_telemetry_its_metres(dive: Path, recording: Path) -> None:
    stated = json.loads((dive / "metric.json").read_text())["sub_maps"]["0"]
    assert stated["metric"]
    assert not stated["level"]
    assert "known length 'marker 7'" in stated["scale_source"]
    (source,) = stated["sources"]
    assert (source["source"], source["kind"], source["used"]) == ("marker 7", "length", 1)
    found, true = read_tum(dive / "trajectory.tum"), read_tum(recording / "poses.tum")
    mine, theirs = associate(found.t_s, true.t_s)
    aligned = align(found.positions[mine], true.positions[theirs], with_scale=True)
    error, sigma = np.log(aligned.T_target_source.scale), np.sqrt(stated["covariance"][6][6])
    assert abs(error) < 0.05
    assert abs(error) < 4.0 * sigma
