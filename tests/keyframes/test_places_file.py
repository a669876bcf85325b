"""places.npz comes back as it was, but for stated rounding; a damaged one is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aquaflow.base.errors import InputError
from aquaflow.geometry.camera import CameraModel
from aquaflow.geometry.similarity import Sim3
from aquaflow.keyframes.place import (
    EDGE,
    LARGEST_ROOT,
    LEVELS,
    NAME,
    UNKNOWN_VARIANCE,
    KeyframePlace,
    KeypointDepths,
    PlacesFile,
    Rows,
    pack,
    unpack,
    write_places,
)
from aquaflow.prior.contract import Keypoints

CAMERA = CameraModel(160, 120, 130.0, 131.0, 80.5, 60.0)


def seen(seed: int, count: int = 50) -> KeypointDepths:
    """Keypoints as SIFT gives them, every fifth without a depth."""
    rng = np.random.default_rng(seed)
    pixels = (rng.uniform(0.0, 1.0, (count, 2)) * (CAMERA.width, CAMERA.height)).astype(np.float32)
    descriptors = np.floor(np.minimum(rng.gamma(0.5, 40.0, (count, 128)), 200.0))
    rho = rng.uniform(0.2, 3.0, count)
    rho[::5] = 0.0
    variance = np.where(rho > 0.0, (0.05 * rho) ** 2, UNKNOWN_VARIANCE)
    return KeypointDepths(CAMERA, Keypoints(pixels, descriptors.astype(np.float32)), rho, variance)


def place(number: int, sub_map: int = 0) -> KeyframePlace:
    T_mc = Sim3.exp(np.linspace(0.0, 0.01 * number, 7))
    return KeyframePlace(number, 7 * number, sub_map, 10**8 * number, T_mc, CAMERA)


def edges(*pairs: tuple[int, int]) -> Rows:
    rows = np.zeros(len(pairs), EDGE)
    rows["a"], rows["b"] = np.array(pairs).T
    rows["R"], rows["scale"], rows["trust"] = np.eye(3), 1.0, 1.0
    rows["information"] = np.eye(7)
    return rows


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / NAME
    places = ((place(number, number // 3), seen(number)) for number in (0, 1, 4))
    assert write_places(path, places, edges((1, 0), (4, 1), (4, 2))) == 3
    return path


def test_keyframes_come_back_one_by_one(written: Path) -> None:
    file = PlacesFile(written)
    assert [found.number for found in file.places] == [0, 1, 4]
    assert [found.sub_map for found in file.places] == [0, 0, 1]
    again, before = file.by_number[4], place(4, 1)
    assert (again.frame_index, again.t_ns, again.camera) == (28, 4 * 10**8, CAMERA)
    assert np.allclose(again.T_mc.matrix, before.T_mc.matrix)
    assert len(file.keypoints(4).rho) == 50


def test_an_edge_to_a_keyframe_that_was_left_out_is_left_out(written: Path) -> None:
    found = PlacesFile(written).edges
    assert list(zip(found["a"], found["b"], strict=True)) == [(1, 0), (4, 1)]


@given(st.integers(0, 2**32 - 1), st.integers(0, 60))
def test_what_is_rounded_stays_within_what_is_stated(seed: int, count: int) -> None:
    before = seen(seed, count)
    after = unpack(pack(before), CAMERA)
    apart = np.abs(after.keypoints.pixels - before.keypoints.pixels)
    assert (apart <= 160 / 2**16 + 1e-5).all()
    assert np.allclose(after.rho, before.rho, rtol=1e-6)
    assert np.array_equal(after.is_known(0.06), before.is_known(0.06))
    assert not after.is_known(0.04).any()
    root = np.sqrt(before.keypoints.descriptors)
    root /= np.maximum(np.linalg.norm(root, axis=1, keepdims=True), 1e-12)
    off = np.abs(np.sqrt(after.keypoints.descriptors) - np.minimum(root, LARGEST_ROOT))
    assert (off <= 0.51 * LARGEST_ROOT / LEVELS).all()


def test_points_lie_where_the_depth_says(written: Path) -> None:
    found = PlacesFile(written).keypoints(1)
    points, there = found.points(), found.rho > 0.0
    assert np.isnan(points[~there]).all()
    assert np.allclose(CAMERA.project(points[there]), found.keypoints.pixels[there], atol=1e-3)
    assert np.allclose(points[there, 2] * found.rho[there], 1.0)


def test_the_same_dive_gives_the_same_bytes(written: Path, tmp_path: Path) -> None:
    second = tmp_path / "second.npz"
    places = ((place(number, number // 3), seen(number)) for number in (0, 1, 4))
    write_places(second, places, edges((1, 0), (4, 1)))
    assert second.read_bytes() == written.read_bytes()


def test_a_missing_file_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is missing"):
        PlacesFile(tmp_path / NAME)


@settings(max_examples=40)
@given(st.data())
def test_a_damaged_file_is_refused_or_whole(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Whatever byte is changed: one sentence, or all of it comes back."""
    folder = tmp_path_factory.mktemp("damaged", numbered=True)
    path = folder / NAME
    write_places(path, [(place(0), seen(0, 6)), (place(1), seen(1, 6))], edges((1, 0)))
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= data.draw(st.integers(1, 255))
    if data.draw(st.booleans()):
        del content[at:]
    path.write_bytes(content)
    try:
        file = PlacesFile(path)
        found = [file.keypoints(each.number) for each in file.places]
    except InputError as error:
        said = str(error)
    else:
        said, lengths = "", [len(each.rho) for each in found]
        assert lengths == [6, 6]
    assert "\n" not in said


@pytest.mark.parametrize(
    "spoilt",
    [
        {"R": 2.0 * np.eye(3)}, {"t": np.full(3, np.nan)}, {"scale": 0.0}, {"fx": 0.0},
        {"width": 0}, {"number": 1},
    ],
)  # fmt: skip
def test_an_index_that_cannot_be_is_refused(tmp_path: Path, spoilt: dict[str, object]) -> None:
    rows = [(place(number), seen(number, 6)) for number in (0, 1)]
    write_places(tmp_path / NAME, rows, edges((1, 0)))
    with np.load(tmp_path / NAME) as file:
        arrays = {name: file[name] for name in file.files}
    for name, value in spoilt.items():
        arrays["index"][name][0] = value
    np.savez(tmp_path / NAME, **arrays)
    with pytest.raises(InputError, match="map the dive again"):
        PlacesFile(tmp_path / NAME)


def test_a_newer_format_is_refused(written: Path) -> None:
    with np.load(written) as file:
        arrays = {name: file[name] for name in file.files}
    arrays["about"] = np.frombuffer(b'{"format": 2}', np.uint8)
    np.savez(written, **arrays)
    with pytest.raises(InputError, match="update AquaFlow"):
        PlacesFile(written)


def test_descriptors_that_the_format_cannot_hold_are_not_kept() -> None:
    before = seen(0)
    wrong = Keypoints(before.keypoints.pixels, -before.keypoints.descriptors - 1.0)
    with pytest.raises(ValueError, match="negative"):
        pack(KeypointDepths(CAMERA, wrong, before.rho, before.variance))
