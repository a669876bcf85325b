"""Gaussian PLY files: round trip, layout, and sentences for files that are none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aquaflow.base.errors import InputError
from aquaflow.dive.ply import PROPERTIES, PlyGaussians, read_ply, write_ply
from aquaflow.geometry.similarity import Sim3


def splats(seed: int = 0, count: int = 7) -> PlyGaussians:
    rng = np.random.default_rng(seed)
    wxyz = rng.normal(size=(count, 4))
    return PlyGaussians(
        means=rng.normal(size=(count, 3)),
        wxyz=wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True),
        scales=np.exp(rng.uniform(-8, 1, size=(count, 3))),
        opacities=rng.uniform(0.001, 0.999, count),
        colours=rng.uniform(size=(count, 3)),
    )


@given(st.integers(0, 2**31), st.integers(0, 40))
def test_round_trip_keeps_every_gaussian(tmp_path_factory, seed, count):
    path = tmp_path_factory.mktemp("ply") / "map.ply"
    written = splats(seed, count)

    assert write_ply(path, written) == 0
    back = read_ply(path)

    for name in ("means", "wxyz", "scales", "opacities", "colours"):
        np.testing.assert_allclose(
            getattr(back, name), getattr(written, name), rtol=2e-5, atol=1e-6
        )


def test_layout_is_that_of_the_reference_code(tmp_path):
    path = tmp_path / "map.ply"
    one = PlyGaussians(
        np.array([[1.0, 2.0, 3.0]]),
        np.array([[2.0, 0.0, 0.0, 0.0]]),
        np.array([[1.0, np.e, 1.0]]),
        np.array([0.5]),
        np.array([[0.5, 0.5 + 0.28209479177387814, 0.5]]),
    )
    write_ply(path, one)

    header, _, body = path.read_bytes().partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n")
    assert [line.split()[2].decode() for line in header.splitlines()[3:]] == list(PROPERTIES)
    expected = [1, 2, 3, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 1, 0, 0, 0]
    np.testing.assert_allclose(np.frombuffer(body, "<f4"), expected, atol=1e-6)


def test_gaussians_that_are_not_finite_are_left_out_and_counted(tmp_path):
    bad = splats(count=6)
    bad.means[0, 1] = np.nan
    bad.scales[1, 0] = 0.0
    bad.scales[2, 0] = -1.0
    bad.wxyz[3] = 0.0
    bad.opacities[4] = np.nan

    assert write_ply(tmp_path / "map.ply", bad) == 5
    np.testing.assert_allclose(read_ply(tmp_path / "map.ply").means, bad.means[5:], rtol=1e-6)


def test_opacities_of_zero_and_one_stay_finite(tmp_path):
    sharp = splats(count=2)
    sharp.opacities[:] = [0.0, 1.0]

    assert write_ply(tmp_path / "map.ply", sharp) == 0
    np.testing.assert_allclose(read_ply(tmp_path / "map.ply").opacities, [0.0, 1.0], atol=2e-6)


def test_float32_map_is_written_without_a_copy_in_another_type(tmp_path):
    single = splats()
    single = PlyGaussians(
        *(getattr(single, f).astype(np.float32) for f in PlyGaussians.__dataclass_fields__)
    )

    assert write_ply(tmp_path / "map.ply", single) == 0


def test_extra_properties_and_elements_are_ignored(tmp_path):
    names = [*PROPERTIES[6:], "f_rest_0", "x", "y", "z"]
    header = ["ply", "format binary_little_endian 1.0", "comment hello", "element vertex 2"]
    header += [f"property float {name}" for name in names]
    header += ["element face 0", "property list uchar int vertex_indices", "end_header", ""]
    rows = np.arange(2 * len(names), dtype="<f4").reshape(2, -1)
    path = tmp_path / "other.ply"
    path.write_bytes("\n".join(header).encode() + rows.tobytes())

    np.testing.assert_array_equal(read_ply(path).means, rows[:, -3:])


HEADER = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"hello", "is not a PLY file"),
        (b"ply\nformat", "is not a PLY file"),
        (b"ply\nformat ascii 1.0\nend_header\n", "is not a binary little-endian PLY"),
        (
            HEADER.encode() + b"property float x\nend_header\n",
            "holds no Gaussians: it lacks f_dc_0",
        ),
        (HEADER.encode() + b"property list uchar int i\nend_header\n", "that no Gaussian map has"),
    ],
)
def test_files_that_are_no_map_are_one_sentence(tmp_path, content, sentence):
    path = tmp_path / "bad.ply"
    path.write_bytes(content)

    with pytest.raises(InputError, match=sentence):
        read_ply(path)


def test_cut_off_map_says_how_much_is_there(tmp_path):
    path = tmp_path / "map.ply"
    write_ply(path, splats(count=7))
    path.write_bytes(path.read_bytes()[:-100])

    with pytest.raises(InputError, match="is cut off: 5 of 7 Gaussians"):
        read_ply(path)


def test_missing_map_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="cannot read the map"):
        read_ply(tmp_path / "none.ply")


def test_transformed_gaussians_have_the_transformed_covariances():
    """Against matrices: C' = s^2 R C R^T, built from each Gaussian's own rotation and scales."""
    before = splats(3)
    T = Sim3(Rotation.from_rotvec([0.3, 2.0, -0.7]).as_matrix(), np.array([1.0, -2.0, 30.0]), 2.5)

    after = before.transform(T)

    np.testing.assert_allclose(after.means, 2.5 * before.means @ T.R.T + T.t, atol=1e-12)
    np.testing.assert_allclose(
        covariances(after), 2.5**2 * T.R @ covariances(before) @ T.R.T, rtol=1e-10, atol=1e-14
    )
    np.testing.assert_array_equal(after.colours, before.colours)
    np.testing.assert_array_equal(after.opacities, before.opacities)


def covariances(splats: PlyGaussians) -> np.ndarray:
    R = Rotation.from_quat(splats.wxyz, scalar_first=True).as_matrix()
    return R @ (splats.scales[:, :, None] ** 2 * np.swapaxes(R, 1, 2))
