"""Readers: from each data set's own layout the same plane comes, in the same world."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.lab.training.datasets.colmap import colmap
from aquaflow.lab.training.datasets.posed import Frames
from aquaflow.lab.training.datasets.simulated import mimir, read_exr, tartanair
from aquaflow.lab.training.datasets.uwstereo import uwstereo
from aquaflow.lab.training.finetune import flsea
from tests.lab.training.data_trees import (
    HEIGHT,
    LARGE,
    STEP_M,
    WIDTH,
    K,
    depth_at,
    picture_at,
    write_colmap,
    write_exr,
    write_flsea,
    write_mimir,
    write_tartanair,
    write_uwstereo,
)

Write, Read = Callable[[Path], None], Callable[[Path], list[Frames]]


def write_tartanair_2(root: Path) -> None:
    write_tartanair(root, version=2)


SETS = {
    "tartanair": (write_tartanair, tartanair),
    "tartanair 2": (write_tartanair_2, tartanair),
    "mimir": (write_mimir, mimir),
    "uwstereo": (write_uwstereo, uwstereo),
    "colmap": (write_colmap, colmap),
    "flsea": (write_flsea, flsea),
}


TOLERANCE_M = {"flsea": 0.02, "uwstereo": 0.02}
"""Poses from keypoints, and depth moved to the nearest pixel of the other view, are less exact."""


@pytest.mark.parametrize("name", SETS)
def test_points_of_all_pictures_lie_on_one_plane(name: str, tmp_path: Path) -> None:
    """Images, depths, intrinsics and poses fit each other: the plane is z = 3 + 0.2 x."""
    write, read = SETS[name]
    write(tmp_path)
    sequence = read(tmp_path)[0]
    assert len(sequence) >= 2
    T_rw = np.linalg.inv(sequence[0].T_wc)
    for index in range(len(sequence)):
        posed = sequence[index]
        assert posed.image.shape[:2] == posed.depth.shape
        rows, columns = np.nonzero(posed.depth > 0.0)
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], -1)
        points = pixels @ np.linalg.inv(posed.K).T * posed.depth[rows, columns, None]
        T = T_rw @ posed.T_wc
        points = points @ T[:3, :3].T + T[:3, 3]
        off = np.abs(points[:, 2] - 3.0 - 0.2 * points[:, 0])
        assert np.percentile(off, 95) < TOLERANCE_M.get(name, 0.005)
        assert T[0, 3] == pytest.approx(index * STEP_M, rel=0.05, abs=1e-6)


def test_pictures_are_rgb_and_intrinsics_those_of_the_set(tmp_path: Path) -> None:
    write_mimir(tmp_path)
    posed = mimir(tmp_path)[0][0]
    np.testing.assert_array_equal(posed.image, picture_at(0.0)[..., ::-1])
    np.testing.assert_allclose(posed.K, K)


def test_a_field_of_view_of_90_degrees_gives_tartanairs_focal_length(tmp_path: Path) -> None:
    write_tartanair(tmp_path)
    assert tartanair(tmp_path)[0][0].K[0, 0] == WIDTH / 2


def test_the_right_view_has_the_depth_of_the_nearer_of_two_points(tmp_path: Path) -> None:
    write_uwstereo(tmp_path, count=1)
    right = uwstereo(tmp_path)[0][1]
    known = right.depth > 0.0
    assert known.mean() > 0.8
    np.testing.assert_allclose(right.depth[known], depth_at(STEP_M)[known], rtol=0.02)


def test_a_stretch_ends_where_neighbours_prove_no_pose(tmp_path: Path) -> None:
    write_flsea(tmp_path, count=5)
    [blank] = (tmp_path / "rock_garden1" / "imgs" / "LFT").glob("*0002.tiff")
    cv2.imwrite(str(blank), np.full((LARGE * HEIGHT, LARGE * WIDTH, 3), 90, np.uint8))
    stretches = flsea(tmp_path)
    assert [len(stretch) for stretch in stretches] == [2, 2]
    assert stretches[0].name == "rock_garden1:0-2"


def test_lens_distortion_is_taken_out_of_picture_and_depth(tmp_path: Path) -> None:
    write_flsea(tmp_path, count=2)
    with (tmp_path / "camera.yaml").open("a") as file:
        file.write("distortion_model: radtan\ndistortion: [0.05, 0.0, 0.0, 0.0]\n")
    posed = flsea(tmp_path)[0][0]
    plain = depth_at(0.0, LARGE * WIDTH, LARGE * HEIGHT)
    middle = posed.depth[LARGE * HEIGHT // 2]
    assert abs(middle[-8] - plain[0, -8]) > 0.01
    assert middle[LARGE * WIDTH // 2] == pytest.approx(plain[0, LARGE * WIDTH // 2], abs=0.01)


@pytest.mark.parametrize("compression", [0, 2, 3])
def test_exr_files_come_back_bit_for_bit(compression: int, tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=(37, 21)).astype(np.float32)
    values[5:20] = 3.5  # compresses well
    write_exr(tmp_path / "depth.exr", values, compression)
    np.testing.assert_array_equal(read_exr(tmp_path / "depth.exr"), values)


@pytest.mark.parametrize("keep", [3, 30, 300])
def test_a_cut_exr_file_is_an_input_error(keep: int, tmp_path: Path) -> None:
    path = tmp_path / "depth.exr"
    write_exr(path, depth_at(0.0))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"cannot read .*depth\.exr"):
        read_exr(path)


@pytest.mark.parametrize("read", [tartanair, mimir, uwstereo, flsea, colmap])
def test_a_folder_without_the_data_set_says_what_was_expected(read: Read, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="give the folder that it was unpacked to"):
        read(tmp_path)


def test_uwstereo_without_cameras_says_what_to_write(tmp_path: Path) -> None:
    write_uwstereo(tmp_path)
    (tmp_path / "stereo.yaml").unlink()
    with pytest.raises(InputError, match=r"baseline_m to .*stereo\.yaml"):
        uwstereo(tmp_path)


def test_a_pose_for_every_picture_or_an_error(tmp_path: Path) -> None:
    write_tartanair(tmp_path)
    path = tmp_path / "ocean" / "Easy" / "P000" / "pose_left.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")
    with pytest.raises(InputError, match="4 pictures and 3 poses"):
        tartanair(tmp_path)


def test_a_picture_without_a_pose_at_its_time_is_left_out(tmp_path: Path) -> None:
    write_mimir(tmp_path)
    path = tmp_path / "SeaFloor" / "auv0" / "track0" / "pose_groundtruth" / "data.csv"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")
    assert len(mimir(tmp_path)[0]) == 3


@pytest.mark.parametrize("damage", [b"", b"\x01", b"\xff" * 100])
def test_a_damaged_colmap_model_is_an_input_error(damage: bytes, tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "reef" / "dense" / "sparse" / "images.bin").write_bytes(damage)
    with pytest.raises(InputError, match="no undistorted COLMAP model"):
        colmap(tmp_path)


def test_a_picture_that_is_gone_is_an_input_error(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    sequence = colmap(tmp_path)[0]
    (tmp_path / "reef" / "dense" / "images" / "IMG_0001.png").unlink()
    with pytest.raises(InputError, match="cannot read the picture"):
        sequence[1]
