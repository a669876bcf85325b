"""Reading trajectories and associating their times."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.dive.tum import write_tum
from aquaflow.geometry.similarity import Sim3
from aquaflow.lab.evaluation.trajectory_error import associate, read_tum

POSE = "0.0 1 2 3 0 0 0 1\n"


@given(st.integers(0, 2**31), st.integers(1, 30))
def test_tum_round_trip_keeps_poses_to_nine_decimals(tmp_path_factory, seed, count):
    rng = np.random.default_rng(seed)
    t_s = np.cumsum(rng.uniform(0.01, 1.0, count))
    positions = rng.normal(scale=100.0, size=(count, 3))
    wxyz = rng.normal(size=(count, 4))
    path = tmp_path_factory.mktemp("tum") / "trajectory.tum"

    write_tum(path, t_s, positions, wxyz)
    back = read_tum(path)

    np.testing.assert_allclose(back.t_s, t_s, atol=1e-9)
    np.testing.assert_allclose(back.positions, positions, atol=1e-9)
    truth = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    np.testing.assert_allclose(back.R_wc, truth, atol=1e-8)


def test_comments_and_blank_lines_are_skipped(tmp_path):
    path = tmp_path / "t.tum"
    path.write_text(f"# heading\n\n{POSE}1.0 1 2 4 0 0 0 1 # tail\n")

    assert len(read_tum(path)) == 2
    assert read_tum(path).path_length == pytest.approx(1.0)


def test_quaternions_are_normalised_and_reordered(tmp_path):
    path = tmp_path / "t.tum"
    path.write_text("0 0 0 0 0 0 0.7071 0.7071\n")

    assert read_tum(path).wxyz[0] == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "holds no pose"),
        (POSE + "1 2 3\n", "line 2: expected the 8 numbers .* found 3"),
        (POSE + "1 2 3 x 0 0 0 1\n", "line 2: these are not 8 numbers"),
        (POSE + "1 2 3 nan 0 0 0 1\n", "line 2: a number is not finite"),
        (POSE + "1 2 3 4 0 0 0 0\n", "line 2: the quaternion's length is 0"),
        (POSE + POSE, "line 2: time 0 s does not come after 0 s"),
    ],
)
def test_malformed_trajectory_is_one_sentence_with_its_line(tmp_path, text, sentence):
    path = tmp_path / "t.tum"
    path.write_text(text)

    with pytest.raises(InputError, match=sentence) as caught:
        read_tum(path)
    assert "\n" not in str(caught.value)


def test_missing_or_binary_trajectory_is_one_sentence(tmp_path):
    (tmp_path / "b.tum").write_bytes(b"\xff\xfe\x00\x80")
    for name in ("none.tum", "b.tum"):
        with pytest.raises(InputError, match="cannot read the trajectory"):
            read_tum(tmp_path / name)


def test_transforming_moves_positions_and_turns_cameras(tmp_path):
    path = tmp_path / "t.tum"
    path.write_text(POSE)
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()

    moved = read_tum(path).transform(Sim3(turn, np.array([0.0, 0.0, 1.0]), 2.0))

    np.testing.assert_allclose(moved.positions[0], [-4.0, 2.0, 7.0], atol=1e-12)
    np.testing.assert_allclose(moved.R_wc[0], turn, atol=1e-12)


@given(st.integers(0, 2**31), st.floats(0.0, 0.04))
def test_association_finds_each_frame_whatever_the_jitter_below_half_a_period(seed, jitter):
    rng = np.random.default_rng(seed)
    truth = np.arange(20) * 0.1
    chosen = np.sort(rng.choice(20, size=8, replace=False))

    ours, theirs = associate(truth[chosen] + rng.uniform(-jitter, jitter, 8), truth, 0.05)

    np.testing.assert_array_equal(ours, np.arange(8))
    np.testing.assert_array_equal(theirs, chosen)


def test_association_is_one_to_one_and_within_tolerance():
    ours, theirs = associate(np.array([0.0, 0.004, 1.0]), np.array([0.003, 5.0]), 0.01)

    assert (ours.tolist(), theirs.tolist()) == ([1], [0])
    assert associate(np.array([]), np.array([1.0]))[0].size == 0
