"""TUM files are written the same way every time, whole or not at all."""

from __future__ import annotations

import numpy as np
import pytest

from aquaflow.base.errors import InputError
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.dive.tum import write_tum

ONE = (np.array([0.5]), np.array([[1.0, -0.0, -1e-12]]), np.array([[-2.0, 0.0, 0.0, 0.0]]))


def test_lines_are_normalised_canonical_and_without_negative_zero(tmp_path):
    write_tum(tmp_path / "t.tum", *ONE, comment="scale: none\nsub-map 0")

    assert (tmp_path / "t.tum").read_text().splitlines() == [
        "# scale: none",
        "# sub-map 0",
        "# t_s tx ty tz qx qy qz qw, camera to world",
        "0.500000000 1.000000000 0.000000000 0.000000000 "
        "0.000000000 0.000000000 0.000000000 1.000000000",
    ]


def test_same_poses_give_the_same_bytes(tmp_path):
    write_tum(tmp_path / "a.tum", *ONE)
    write_tum(tmp_path / "b.tum", *ONE)

    assert (tmp_path / "a.tum").read_bytes() == (tmp_path / "b.tum").read_bytes()


def test_interrupted_write_leaves_the_old_file_and_no_part(tmp_path):
    path = tmp_path / "t.tum"
    path.write_text("old")

    def interrupted() -> None:
        with atomic_write(path) as stream:
            stream.write(b"new")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_folder_that_is_not_there_is_one_sentence(tmp_path):
    with pytest.raises(
        InputError, match=r"cannot write .* No such file or directory; give a folder"
    ):
        write_tum(tmp_path / "none" / "t.tum", *ONE)


def test_a_pose_that_is_not_finite_is_not_written(tmp_path):
    t_s, positions, wxyz = ONE
    with pytest.raises(ArithmeticError):
        write_tum(tmp_path / "t.tum", t_s, positions * np.nan, wxyz)
    assert list(tmp_path.iterdir()) == []
